"""From rays and a field to composited coefficients."""
