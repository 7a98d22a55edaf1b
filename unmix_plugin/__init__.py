"""From posed spectral images to a 3-D scene that knows what it is made of."""

__version__ = "0.1.0"
