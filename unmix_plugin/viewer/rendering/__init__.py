"""From cameras of browsers to pictures."""
