"""Materials that look alike in one light and differ in another: a table and a figure of swatches.

Surfaces are the endmembers of a run, as reflectances (radiance over the scene's light, which is taken as flat where it
is unknown), and measured materials of the library that reach all of the run's visible bands with light; the other
bands play no part.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from unmix_plugin.engine.printing import plot_text
from unmix_plugin.errors import SpectrumError
from unmix_plugin.figures.plotting import draw_swatch, figure_bytes, page_in_inches
from unmix_plugin.formats.files import csv_bytes, write_file
from unmix_plugin.formats.libraries import library_of
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Metamerism
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import illuminant_power, parse_light
from unmix_plugin.spectral.colour.difference import (
    MetamericPair,
    lab_to_srgb,
    metameric_pairs,
    reflectance_to_lab,
)
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.run_materials import LIGHT_UNKNOWN

_MOST_DRAWN = 12
_NAME_WIDTH, _CELL, _ROW, _HEADING, _MARGIN = 3.4, 1.5, 0.62, 0.75, 0.2
_SWATCH = 0.46


@dataclass(frozen=True)
class _Metamers:
    """What was found."""

    names: tuple[str, ...]
    """Of all surfaces looked at."""
    reflectance: Float64[np.ndarray, "N B"]
    bands: Bands
    lights: tuple[str, ...]
    powers: Float64[np.ndarray, "L B"]
    pairs: list[MetamericPair]
    """Those with an endmember of the run first, each kind by its greatest difference."""


def export(job: Job, asked: Metamerism) -> list[Path]:
    """Compare all pairs in all lights; write them as CSV, and swatches of the first dozen in every light."""
    table_path, figure_path = job.folder / "metamerism.csv", job.folder / "metamerism.png"
    job.claim([table_path, figure_path])
    if asked.surfaces != "library" and not job.materials.is_light_known:
        job.say(LIGHT_UNKNOWN)
    with job.working("comparing colours"):
        found = find_metamers(job.materials, asked)
        rows = [
            [
                "first",
                "second",
                "alike in",
                "different in",
                *(f"CIEDE2000 in {light}" for light in found.lights),
            ]
        ]
        for pair in found.pairs:
            lights = [found.lights[index] for index in (pair.alike_in, pair.different_in)]
            differences = [f"{value:.3f}" for value in pair.differences]
            rows.append([found.names[pair.first], found.names[pair.second], *lights, *differences])
        written = [write_file(table_path, csv_bytes(rows)), write_file(figure_path, _draw_metamers(found))]
    job.say(
        f"{len(found.pairs)} pairs of {len(found.names)} materials, seen in {', '.join(found.lights)} "
        f"over {found.bands}"
    )
    return written


def find_metamers(materials: Materials, asked: Metamerism) -> _Metamers:
    kept = materials.bands.visible_mask & materials.is_lit.cpu().numpy()
    if not kept.any():
        raise SpectrumError(f"{materials.bands} hold no visible light, so nothing is known of metamerism")
    bands = Bands.of(materials.bands.centers_nm[kept])
    lights = [parse_light(word) for word in asked.lights]
    powers = np.array([illuminant_power(light, bands) for light in lights]).reshape(-1, len(bands))
    names: list[str] = []
    rows: list[Float64[np.ndarray, " B"]] = []
    if asked.surfaces != "library":
        light = 1.0 if materials.light is None else materials.light.double()
        names += materials.names
        rows += list((materials.endmembers.detach().double() / light).cpu().numpy()[:, kept])
    num_own, library = len(names), library_of(asked.library, bands)
    for material in library.materials if asked.surfaces != "run" else ():
        try:
            known = library.reflectance(material.name, bands)
        except SpectrumError:  # of those that do not reach all bands
            continue
        library.require_reflectance(material.name, known, f"{material.name} ({material.source})")
        rows.append(known)
        names.append(material.name)
    reflectance = np.array(rows).reshape(len(names), len(bands))
    pairs = metameric_pairs(reflectance, powers, bands, asked.alike, asked.different)
    pairs.sort(key=lambda pair: pair.first >= num_own)  # stable
    labels = tuple(light.stem if isinstance(light, Path) else light for light in lights)
    return _Metamers(tuple(names), reflectance, bands, labels, powers, pairs)


def _draw_metamers(found: _Metamers) -> bytes:
    """A row a pair, a column a light: both surfaces side by side as an eye adapted to the light sees them."""
    drawn = found.pairs[:_MOST_DRAWN]
    columns = [_MARGIN + _NAME_WIDTH + index * _CELL for index in range(max(3, len(found.lights)))]
    top = _ROW * max(1, len(drawn)) + _MARGIN
    figure, page = page_in_inches(columns[-1] + _CELL + _MARGIN, top + _HEADING + _MARGIN)
    heading = f"{len(found.pairs)} pairs of {len(found.names)} materials look alike in one light, different in another"
    page.text(_MARGIN, top + _HEADING, heading, fontsize=11, fontweight="bold", va="top")
    labels = ["CIEDE2000 beside the swatches", *found.lights]
    for label, left in zip(labels, [_MARGIN, *columns], strict=False):
        page.text(left, top + 0.07, plot_text(label), fontsize=10, va="bottom")
    labs = [reflectance_to_lab(found.reflectance, power, found.bands) for power in found.powers]
    for row, pair in enumerate(drawn):
        base, surfaces = top - (row + 1) * _ROW, [pair.first, pair.second]
        for index, surface in enumerate(surfaces):
            page.text(
                _MARGIN,
                base + 0.36 - 0.2 * index,
                plot_text(found.names[surface][:42]),
                fontsize=9,
                va="center",
            )
        for left, lab, difference in zip(columns, labs, pair.differences, strict=False):
            for index, colour in enumerate(lab_to_srgb(lab[surfaces])):
                draw_swatch(page, colour, (left + index * _SWATCH, base + 0.06), _SWATCH, "none")
            page.text(left + 2 * _SWATCH + 0.08, base + 0.29, f"{difference:.1f}", fontsize=10, va="center")
    return figure_bytes(figure)
