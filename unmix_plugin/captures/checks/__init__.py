"""What looks wrong with a capture, measured on the scene that was made of it."""
