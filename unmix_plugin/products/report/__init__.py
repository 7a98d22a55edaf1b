"""The report: one HTML page about a run."""

from unmix_plugin.products.report.report import export as export
