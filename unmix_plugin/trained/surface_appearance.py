"""What every point of a surface carries: its colour, its material, its abundances; the same in all formats.

Notation: `P` points, `K` endmembers.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from torch import Tensor

from unmix_plugin.spectral.colour.conversion import describe_colour, linear_to_srgb, rgb_matrix
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.segmentation import material_ids, material_scores
from unmix_plugin.trained.run_materials import endmember_colours


@dataclass(frozen=True)
class SurfaceAppearance:
    """Colour, material and abundances of points."""

    materials: Materials
    abundances: Float[Tensor, "P K"]
    """Summing to 1."""
    diffuse: Float[Tensor, "P B"]
    """Spectra without the view-dependent part."""

    @property
    def linear_rgb(self) -> Float32[np.ndarray, "P 3"]:
        """Linear light in sRGB primaries, [0, 1]."""
        matrix = rgb_matrix(self.materials.bands, torch.float64)
        return (self.diffuse.double().clamp(0, 1) @ matrix).clamp(0, 1).float().numpy()

    @property
    def srgb(self) -> Float64[np.ndarray, "P 3"]:
        """Colours for displays, [0, 1]."""
        return linear_to_srgb(torch.from_numpy(self.linear_rgb).double()).numpy()

    @property
    def material_ids(self) -> UInt8[np.ndarray, " P"]:
        """Material of each point, chosen as in segmentations."""
        by_angle = self.materials.segmentation == "probe"
        endmembers = self.materials.endmembers.detach().cpu()
        scores = material_scores(self.diffuse, endmembers) if by_angle else self.abundances
        return material_ids(scores, torch.ones(len(scores))).numpy()

    @property
    def palette(self) -> Float64[np.ndarray, "K 3"]:
        """sRGB colours that stand for the materials."""
        return endmember_colours(self.materials)

    def properties(self) -> dict[str, np.ndarray]:
        """red, green, blue (uint8), material (uint8) and `abundance_NAME` (float32) of each point."""
        colours = np.round(255 * self.srgb).astype(np.uint8)
        named = {name: colours[:, axis] for axis, name in enumerate(("red", "green", "blue"))}
        shares = self.abundances.numpy().astype(np.float32)
        columns = {name: shares[:, index] for index, name in enumerate(property_names(self.materials.names))}
        return {**named, "material": self.material_ids, **columns}

    def comments(self, what: str) -> list[str]:
        """What a file says of itself."""
        colours = describe_colour(self.materials.bands)
        materials = [f"material {index}: {name}" for index, name in enumerate(self.materials.names)]
        return [what, f"coordinates: world of the scene's transforms.json; {colours}", *materials]


def property_names(names: tuple[str, ...]) -> list[str]:
    """Names of abundances as formats without spaces take them, all different.

    >>> property_names(("red clay", "red-clay", "leaf"))
    ['abundance_red_clay', 'abundance_red_clay_1', 'abundance_leaf']
    """
    plain: list[str] = []
    for index, name in enumerate(names):
        short = "abundance_" + (re.sub(r"[^0-9A-Za-z]+", "_", name).strip("_") or str(index))
        plain.append(f"{short}_{index}" if short in plain else short)
    return plain
