"""Outputs that take an argument after a colon: bands, false colours, spectral indices, targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from unmix_plugin.engine.registry import OutputKind
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.colour.conversion import band_composite_matrix
from unmix_plugin.spectral.maps.reflectance_maps import parse_reflectance_map
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.material_view import MaterialView


@dataclass(frozen=True)
class FamilyMember:
    """One output of a family."""

    what: str
    """What its numbers are."""
    compute: Callable[[MaterialView], Tensor]
    value_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class OutputFamily:
    """Outputs of one kind that differ by an argument."""

    kind: OutputKind
    title: str
    needs: str
    """What the argument is."""
    example: str
    make: Callable[[str, str, Materials], FamilyMember]
    """From name, argument and materials to the output.

    Raises:
        ConfigError: the argument can't be read.
        SpectrumError: the bands don't cover it.
    """


def _band(name: str, argument: str, materials: Materials) -> FamilyMember:
    band = materials.bands.nearest(_wavelength_nm(argument, name))
    column = torch.eye(len(materials.bands))[:, band : band + 1]
    return FamilyMember(
        f"radiance of one band on black, 1 = full scale: {argument}",
        lambda view: view.materials.through(view.coefficients, column)[..., 0],
    )


def _false_colour(name: str, argument: str, materials: Materials) -> FamilyMember:
    wavelengths = [_wavelength_nm(part, name) for part in argument.split(",")]
    if len(wavelengths) != 3:
        raise ConfigError(
            f"false-colour takes three wavelengths, as in {FAMILIES['false-colour'].example}; got {name}"
        )
    matrix = band_composite_matrix(materials.bands, (wavelengths[0], wavelengths[1], wavelengths[2]))
    return FamilyMember(
        f"three bands as red, green and blue, radiance on black: {argument}",
        lambda view: view.materials.through(view.coefficients, matrix).clamp(0, 1),
    )


def _reflectance_map(name: str, _: str, materials: Materials) -> FamilyMember:
    asked = parse_reflectance_map(name, materials.bands)
    caveat = "" if materials.light is not None else "; of radiance, since the scene's light is unknown"

    def compute(view: MaterialView) -> Tensor:
        reflectance = view.materials.reflectance(view.coefficients)
        return asked.fit(reflectance[view.coefficients.is_occupied])(reflectance)

    return FamilyMember(f"{asked.what}{caveat}; NaN where undefined", compute, asked.usual_range)


def _wavelength_nm(text: str, name: str) -> float:
    try:
        return float(text.strip().removesuffix("nm"))
    except ValueError:
        raise ConfigError(f"{text!r} in the output {name} is not a wavelength in nm, such as 650nm") from None


FAMILIES: dict[str, OutputFamily] = {
    "band": OutputFamily("grey", "one band", "a wavelength", "band:650nm", _band),
    "false-colour": OutputFamily(
        "linear", "false colour", "wavelengths", "false-colour:860,650,550", _false_colour
    ),
    "index": OutputFamily("map", "spectral index", "to know which", "index:ndvi", _reflectance_map),
    "target": OutputFamily(
        "map", "likeness to a target", "to know which", "target:paint.csv", _reflectance_map
    ),
}
"""By the part of the name before the colon."""
