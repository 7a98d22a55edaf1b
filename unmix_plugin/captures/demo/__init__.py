"""The built-in scene as an instrument would have written it."""
