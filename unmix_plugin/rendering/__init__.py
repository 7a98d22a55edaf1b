"""Differentiable rendering operators, each a Warp kernel and a PyTorch twin that defines it."""

from unmix_plugin.rendering.compositing import (
    accumulate,
    accumulate_twin,
    volume_weights,
    volume_weights_twin,
)
from unmix_plugin.rendering.hash_encoding import HashGridLayout, hash_encode, hash_encode_twin
from unmix_plugin.rendering.marching import PackedSamples, march, march_twin
from unmix_plugin.rendering.occupancy import OccupancyGrid

__all__ = [
    "HashGridLayout",
    "OccupancyGrid",
    "PackedSamples",
    "accumulate",
    "accumulate_twin",
    "hash_encode",
    "hash_encode_twin",
    "march",
    "march_twin",
    "volume_weights",
    "volume_weights_twin",
]
