"""One HTML page that shows a run in 3-D, to mail to others."""

from unmix_plugin.products.page.page import export as export
