"""Formats that products come in, as the command line names them."""

from typing import Literal

CubeFormat = Literal["envi", "exr", "npy"]
"""Spectral images."""

ShareFormat = Literal["npy", "png", "envi", "exr"]
"""Shares of the endmembers."""

MeshFormat = Literal["ply", "glb", "obj"]
"""Surfaces."""
