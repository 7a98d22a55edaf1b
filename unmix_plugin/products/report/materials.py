"""The section of a report about the endmembers: their spectra, and what they resemble.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
import torch
from jaxtyping import Float64

from unmix_plugin.figures.html_page import Section, css_colour, figures, paragraph, swatch, table
from unmix_plugin.figures.svg_chart import Chart, Line, draw_chart, draw_key
from unmix_plugin.spectral.composition import Materials
from unmix_plugin.spectral.library.material_library import MaterialLibrary
from unmix_plugin.spectral.metrics import match_endmembers
from unmix_plugin.trained.library_matches import LIGHT_UNKNOWN, ShownMatch, shown_matches
from unmix_plugin.trained.run_materials import endmember_colours

_DASHES = ("7 4", "2 3", "10 3 2 3")
_GREYS = ("#4b545c", "#7a838b", "#a2aab1")


def materials_section(
    materials: Materials,
    proportions: Float64[np.ndarray, " K"],
    light: Float64[np.ndarray, " B"] | None,
    library: MaterialLibrary,
    truth: tuple[Sequence[str], Float64[np.ndarray, "M B"]] | None,
) -> Section:
    """A card for each endmember.

    Args:
        materials: Of the model.
        proportions: Part of all that is seen that each is.
        light: In which the spectra are seen; None where it is unknown.
        library: Known materials.
        truth: Names and radiance of the true materials, where the run knows them.
    """
    spectra = materials.endmembers.detach().cpu().double().numpy()
    matches = shown_matches(spectra, materials.bands, light, library)
    partners = _partners(spectra, truth)
    cards = [
        _card(materials, index, float(proportions[index]), matches[index], partners.get(index))
        for index in range(len(materials.names))
    ]
    note = (
        f"Radiance in the light of the scene, 1 = full scale; the three nearest of {len(library.names)} known "
        "materials by spectral angle of reflectance, drawn in the same light and brightness. An angle above about "
        "0.1 rad is no match but the nearest there is. Parts are means of abundances over what the rendered views show."
    )
    html = paragraph(note, "note") + (paragraph(LIGHT_UNKNOWN, "warning") if light is None else "")
    return Section("materials", "Materials", html + figures(cards, 2))


def _partners(
    spectra: Float64[np.ndarray, "K B"], truth: tuple[Sequence[str], Float64[np.ndarray, "M B"]] | None
) -> dict[int, tuple[str, float, Float64[np.ndarray, " B"]]]:
    """True material of each endmember that has one: name, angle and radiance, as bright as the endmember."""
    if truth is None:
        return {}
    names, radiance = truth
    found = match_endmembers(torch.from_numpy(spectra), torch.from_numpy(radiance))
    triples = zip(found.pred_ids, found.true_ids, found.angles, strict=True)
    return {
        pred: (names[true], angle, radiance[true] * _brightness(spectra[pred], radiance[true]))
        for pred, true, angle in triples
    }


def _brightness(spectrum: Float64[np.ndarray, " B"], other: Float64[np.ndarray, " B"]) -> float:
    power = float(other @ other)
    return float(other @ spectrum) / power if power > 0 else 0.0


def _card(
    materials: Materials,
    index: int,
    proportion: float,
    matches: Sequence[ShownMatch],
    partner: tuple[str, float, Float64[np.ndarray, " B"]] | None,
) -> str:
    name, colour = materials.names[index], endmember_colours(materials)[index]
    wavelengths = materials.bands.centers_nm
    spectrum = materials.endmembers[index].detach().cpu().double().numpy()
    lines = [
        Line(wavelengths, shown.spectrum, shown.match.name, grey, 1.5, dashes)
        for shown, grey, dashes in zip(matches, _GREYS, _DASHES, strict=False)
    ]
    rows = [
        [draw_key(line), f"{shown.match.angle_rad:.3f}", str(shown.match.num_bands)]
        for line, shown in zip(lines, matches, strict=True)
    ]
    if partner is not None:
        true = Line(wavelengths, partner[2], f"true: {partner[0]}", "#111111", 1.5)
        lines.append(true)
        rows.append([draw_key(true), f"{partner[1]:.3f}", str(len(wavelengths))])
    lines.append(Line(wavelengths, spectrum, name, css_colour(colour), 3.0))
    chart = Chart(
        lines, "wavelength (nm)", "radiance", f"spectrum of {name}", from_zero=True, size=(480.0, 240.0)
    )
    listed = (
        table(["known material", "angle (rad)", "bands"], rows, numeric=(1, 2), cells_are_html=True)
        if rows
        else paragraph("No known material covers enough of the bands.", "note")
    )
    title = f'{swatch(colour)}{escape(name)} <span class="note">{proportion:.1%} of what is seen</span>'
    return f'<div class="card"><h3>{title}</h3>{draw_chart(chart)}{listed}</div>'
