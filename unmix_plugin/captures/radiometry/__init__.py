"""Cameras that write their own calibration into their files: from stored numbers to radiance."""

from unmix_plugin.captures.radiometry.model import RadiometricModel, radiometric_model

__all__ = ["RadiometricModel", "radiometric_model"]
