"""All that light does: lamp, shading, shadows, gains of views."""
