"""The spectrum of a place as files: a table, a plot, and what it is made of.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from unmix_plugin.formats.files import figure_bytes, make_folder, write_file
from unmix_plugin.spectral.composition import OCCUPIED_ACCUMULATION, Materials
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.trained.library_matches import ShownMatch, match_json
from unmix_plugin.trained.probe import Probe
from unmix_plugin.trained.run_materials import endmember_colours

_DPI = 130
_MOST_BARS = 12


@dataclass(frozen=True)
class ProbedPlace:
    """A place, and all that is known of it."""

    title: str
    """For people."""
    facts: dict[str, Any]
    """Where it is, as JSON has it."""
    probe: Probe
    measured: Float[np.ndarray, " B"] | None
    """Spectrum that the scene has there, in the light of the prediction."""
    matches: Sequence[ShownMatch]
    """Known materials that the predicted spectrum resembles, nearest first; none where nothing is."""


def spectrum_paths(folder: Path, name: str) -> list[Path]:
    """Files that `write_spectrum` makes."""
    return [folder / f"{name}.{kind}" for kind in ("csv", "json", "png")]


def write_spectrum(folder: Path, name: str, place: ProbedPlace, materials: Materials) -> list[Path]:
    """Write NAME.csv (`wavelength,predicted,...`, `measured` where it is known), NAME.json (where the place is, its
    opacity, abundances and nearest known materials) and NAME.png, a plot.

    Raises:
        RunError: the disk is full or refuses.
    """
    table_path, facts_path, plot_path = spectrum_paths(make_folder(folder), name)
    columns = dict(place.probe.spectra)
    if place.measured is not None:
        columns["measured"] = place.measured.astype(np.float64)
    table = SpectraTable(materials.bands, tuple(columns), np.stack(list(columns.values())))
    write_spectra_csv(table_path, table)
    content = json.dumps(_facts(place, materials), indent=1, allow_nan=False) + "\n"
    write_file(facts_path, content.encode())
    return [table_path, facts_path, write_file(plot_path, draw_spectrum(place, materials))]


def draw_spectrum(place: ProbedPlace, materials: Materials) -> bytes:
    """The spectra over wavelength, and the abundances beside them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 4.4), layout="constrained", facecolor="white")
    lines, bars = figure.subplots(1, 2, width_ratios=[2.4, 1])
    wavelengths = materials.bands.centers_nm
    if place.measured is not None:
        lines.plot(wavelengths, place.measured, color="0.55", linewidth=3.5, label="measured")
    lines.plot(wavelengths, place.probe.spectra["predicted"], color="black", linewidth=1.8, label="predicted")
    for style, shown in zip(("--", "-.", ":"), place.matches, strict=False):
        label = f"{shown.match.name} ({shown.match.angle_rad:.3f} rad)"
        lines.plot(wavelengths, shown.spectrum, linestyle=style, linewidth=1.3, label=label)
    lines.set(xlabel="wavelength (nm)", ylabel="radiance (1 = full scale)")
    lines.set_ylim(bottom=0.0)
    lines.set_title(place.title, loc="left", fontweight="bold")
    lines.grid(color="0.9")
    lines.legend(frameon=False)
    _draw_abundances(bars, place.probe, materials)
    for axes in (lines, bars):
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    return figure_bytes(figure, _DPI)


def _draw_abundances(axes: Any, probe: Probe, materials: Materials) -> None:
    """The largest abundances as bars, the largest on top."""
    chosen = np.argsort(-probe.abundances, kind="stable")[:_MOST_BARS]
    colours = endmember_colours(materials)
    axes.barh(
        range(len(chosen)),
        probe.abundances[chosen],
        color=[tuple(colours[index]) for index in chosen],
        edgecolor="0.3",
        linewidth=0.6,
    )
    axes.set_yticks(range(len(chosen)), [materials.names[index] for index in chosen])
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel("abundance")
    axes.set_title(f"opacity {probe.opacity:.2f}", loc="left")


def _facts(place: ProbedPlace, materials: Materials) -> dict[str, Any]:
    probe = place.probe
    is_something = probe.opacity >= OCCUPIED_ACCUMULATION
    shares = dict(zip(materials.names, probe.abundances.tolist(), strict=True))
    position = probe.world_position
    return {
        **place.facts,
        "world_position": None if position is None else position.tolist(),
        "opacity": probe.opacity,
        "material": max(shares, key=lambda name: shares[name]) if is_something else None,
        "abundances": shares,
        "library": [match_json(shown.match) for shown in place.matches],
    }
