"""Colour: spectra to sRGB, illuminants, colour differences."""
