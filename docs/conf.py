"""Sphinx's settings for the site, which `scripts/build_site.sh` makes."""

from unmix_plugin import __version__

project = "unmix-nerf"
author = "the authors of unmix-nerf"
version = release = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

# Headings get the anchors that GitHub gives them, so that one link works in both places.
myst_heading_anchors = 3
myst_enable_extensions = ["deflist"]
nb_execution_mode = (
    "off"  # notebooks show the outputs that they are committed with: `scripts/run_notebooks.py`
)

# Docstrings are plain text with `code` in single backticks.
default_role = "literal"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_format = "short"
autodoc_typehints_description_target = "documented"
autodoc_preserve_defaults = True
python_maximum_signature_line_length = 80

highlight_language = "none"
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"unmix-nerf {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_theme_options = {"navigation_with_keys": True}
