"""What a report says about the endmembers: their spectra, and what they resemble.

Notation: `B` bands, `K` endmembers, `M` true materials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64

from unmix_plugin.figures.plotting import ChartLine, LineChart, css_colour
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.metrics import match_endmembers
from unmix_plugin.trained.library_matches import ShownMatch, shown_matches
from unmix_plugin.trained.run_materials import endmember_colours

_STYLES = (("dashed", "#4b545c"), ("dotted", "#7a838b"), ("solid", "#a2aab1"))


@dataclass(frozen=True)
class TrueMaterials:
    """What is known of the scene's materials."""

    names: Sequence[str]
    radiance: Float64[np.ndarray, "M B"]
    """In the light of the model."""


@dataclass(frozen=True)
class MaterialCard:
    """What is shown of an endmember."""

    name: str
    colour: Float[np.ndarray, "3"]
    proportion: float
    """Part of all that is seen."""
    chart: LineChart
    matches: Sequence[tuple[ChartLine, float, int]]
    """What it resembles: line, angle in radians, bands compared."""


def material_cards(
    materials: Materials,
    proportions: Float64[np.ndarray, " K"],
    light: Float64[np.ndarray, " B"] | None,
    library: MaterialLibrary,
    truth: TrueMaterials | None,
) -> list[MaterialCard]:
    """A card for each endmember.

    Args:
        materials: The scene's materials.
        proportions: Part of all that is seen that each is.
        light: In which the spectra are seen; None where it is unknown.
        library: Known materials.
        truth: True materials, where they are known.
    """
    spectra = materials.endmembers.detach().cpu().double().numpy()
    colours = endmember_colours(materials)
    wavelengths = materials.bands.centers_nm
    known = shown_matches(spectra, materials.bands, light, library)
    partners = {} if truth is None else _partners(spectra, truth, wavelengths)
    cards: list[MaterialCard] = []
    for index, name in enumerate(materials.names):
        matches = [*_known_lines(known[index], wavelengths), *partners.get(index, ())]
        own = ChartLine(wavelengths, spectra[index], name, css_colour(colours[index]), 3.0)
        lines = [*(line for line, *_ in matches), own]
        chart = LineChart(lines, "wavelength (nm)", "radiance", from_zero=True, size=(480.0, 240.0))
        cards.append(MaterialCard(name, colours[index], float(proportions[index]), chart, matches))
    return cards


def _known_lines(
    matches: Sequence[ShownMatch], wavelengths: np.ndarray
) -> list[tuple[ChartLine, float, int]]:
    return [
        (
            ChartLine(wavelengths, shown.spectrum, shown.match.name, grey, 1.5, dash),
            shown.match.angle_rad,
            shown.match.num_bands,
        )
        for shown, (dash, grey) in zip(matches, _STYLES, strict=False)
    ]


def _partners(
    spectra: Float64[np.ndarray, "K B"], truth: TrueMaterials, wavelengths: np.ndarray
) -> dict[int, list[tuple[ChartLine, float, int]]]:
    """The true material of each endmember that has one, as bright as the endmember."""
    found = match_endmembers(torch.from_numpy(spectra), torch.from_numpy(truth.radiance))
    partners: dict[int, list[tuple[ChartLine, float, int]]] = {}
    for pred, true, angle in zip(found.pred_ids, found.true_ids, found.angles, strict=True):
        other = truth.radiance[true]
        power = float(other @ other)
        brightness = float(other @ spectra[pred]) / power if power > 0 else 0.0
        line = ChartLine(wavelengths, brightness * other, f"true: {truth.names[true]}", "#111111", 1.5)
        partners[pred] = [(line, angle, len(wavelengths))]
    return partners
