"""The measured pixels that training draws from, of views of any size and sensor."""

from unmix_plugin.scenes.pixel_table.block import DrawnPixels
from unmix_plugin.scenes.pixel_table.table import Components, PixelTable

__all__ = ["Components", "DrawnPixels", "PixelTable"]
