"""What is special about exporting a spectral material: its look in colours, its abundances and its endmembers.

Notation: `T` texels in charts, `K` endmembers, `B` bands, `N` points, `P` parameters.
"""

from __future__ import annotations

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.formats.exr import write_exr
from unmix_plugin.neumatex.material_export.baking import BakedMaterial
from unmix_plugin.neumatex.materials.spectral import SpectralFamily
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.materials import default_names


class InColours:
    """A spectral family as an eye sees it in light of a flat spectrum: the same materials in three colours."""

    num_colours = 3

    def __init__(self, family: SpectralFamily, bands: Bands) -> None:
        self._family = family
        self._matrix = rgb_matrix(bands).to(family.endmembers)
        self.num_parameters = family.num_parameters

    def evaluate(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """Reflectance, 1/sr, without the cosine."""
        return (self._family.evaluate(parameters, wi, wo) @ self._matrix).clamp(min=0)

    def sample(
        self, parameters: Float[Tensor, "N P"], wo: Float[Tensor, "N 3"], uniforms: Float[Tensor, "N 3"]
    ) -> Float[Tensor, "N 3"]:
        """As of the spectral family."""
        return self._family.sample(parameters, wo, uniforms)

    def density(
        self, parameters: Float[Tensor, "N P"], wi: Float[Tensor, "N 3"], wo: Float[Tensor, "N 3"]
    ) -> Float[Tensor, " N"]:
        """As of the spectral family."""
        return self._family.density(parameters, wi, wo)

    def base_colour(self, parameters: Float[Tensor, "N P"]) -> Float[Tensor, "N 3"]:
        """Colour of the diffuse reflectance, linear, [0, 1]."""
        return (self._family.base_colour(parameters) @ self._matrix).clamp(0, 1)


def spectral_paths(folder: Path) -> list[Path]:
    """Files that `write_spectral_files` makes."""
    return [folder / name for name in ("abundances.exr", "endmembers.csv")]


def write_spectral_files(
    folder: Path, baked: BakedMaterial, family: SpectralFamily, bands: Bands
) -> list[Path]:
    """Write abundances as one texture, a channel an endmember, and the endmembers' reflectances.

    Raises:
        RunError: the disk is full or refuses.
    """
    textures, table = spectral_paths(folder)
    names = default_names(family.num_endmembers)
    shares = baked.texture(family.abundances(baked.parameters))
    # Readers get channels in the order of their names.
    channels = {f"{index:02d} {name}": shares[..., index] for index, name in enumerate(names)}
    write_exr(textures, channels, {"comments": "shares of the endmembers of endmembers.csv; linear"})
    reflectances = family.endmembers.detach().to("cpu", torch.float64).numpy()
    write_spectra_csv(table, SpectraTable(bands, names, reflectances))
    return [textures, table]
