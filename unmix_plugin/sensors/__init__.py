"""What a sensor sees of a spectrum."""
