"""What the viewer can show of a rendered view."""
