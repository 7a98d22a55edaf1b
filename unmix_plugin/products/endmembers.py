"""Endmember spectra: a table, a spectral library and a plot over wavelength."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, Shaped

from unmix_plugin.engine.printing import plot_text
from unmix_plugin.engine.runs.replacing import remove
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.plotting import figure_bytes, plain_axes
from unmix_plugin.formats.envi import envi_library_paths, write_envi_library
from unmix_plugin.formats.files import csv_bytes, make_folder, write_file
from unmix_plugin.formats.libraries import library_of
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Endmembers
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.intervals import COVERAGE, Interval
from unmix_plugin.spectral.library.material_library import Comparison, MaterialLibrary
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.run_materials import LIGHT_UNKNOWN, endmember_colours

_LINE_STYLES = ("-", "--", "-.", ":")
_LEGEND_ROWS = 16


def export(job: Job, asked: Endmembers) -> list[Path]:
    """Write table, library and plot, and in the run's own bands the angles to all known spectra."""
    materials, paths, angles_path = job.materials, _endmember_paths(job.folder), job.folder / "angles.csv"
    if materials.sensor is not None:
        if asked.library:
            raise ConfigError(
                "--library is compared with in the run's own bands; leave out --library or --sensor"
            )
        job.claim([*paths, angles_path])
        job.say("without angles.csv: known spectra are compared in the run's own bands, without --sensor")
        nothing = Interval.unknown(np.zeros(materials.endmembers.shape), COVERAGE, "")
        write_endmembers(job.folder, materials, nothing)  # errors are known in the run's own bands
        remove(angles_path)  # of an earlier export, to spectra in other bands
        return [path for path in paths if path.exists()]
    light = job.scene.light_power
    known = library_of(asked.library, materials.bands, light)
    job.claim([*paths, angles_path])
    if not materials.is_light_known:
        job.say(LIGHT_UNKNOWN)
    interval = job.scene.endmember_interval()
    write_endmembers(job.folder, materials, interval)
    if interval.not_determined:
        unknown = [
            name for name, low in zip(materials.names, interval.low, strict=True) if np.isnan(low).all()
        ]
        job.say(f"intervals not determined, of {', '.join(unknown)}: {interval.not_determined}")
    table = materials.table()
    angles = angles_csv(known, table.names, table.spectra, table.bands, light, asked.compare)
    return [*(path for path in paths if path.exists()), write_file(angles_path, angles)]


def angles_csv(
    library: MaterialLibrary,
    names: Sequence[str],
    spectra: Float[np.ndarray, "K B"],
    bands: Bands,
    light: Float64[np.ndarray, " B"] | None,
    comparison: Comparison = "scale",
) -> bytes:
    """Angles in radians between all known spectra and all given ones: a row a known one, with its source and over how
    many bands it was compared; empty where it covers too few.
    """
    angles, counts = library.angles(spectra, bands, light, comparison)
    known = zip(library.materials, counts, angles.T, strict=True)
    rows = [
        [one.name, one.source, count, *("" if np.isnan(angle) else f"{angle:.6f}" for angle in row)]
        for one, count, row in known
    ]
    return csv_bytes([["known", "source", "bands", *names], *rows])


def _endmember_paths(folder: Path) -> list[Path]:
    base = folder / "endmembers"
    return [
        folder / "endmembers.csv",
        folder / "endmembers-intervals.csv",
        *envi_library_paths(base),
        folder / "endmembers.png",
    ]


def write_intervals(path: Path, bands: Bands, names: Sequence[str], interval: Interval) -> None:
    """Write the ends of the intervals of endmembers as CSV, columns NAME_low and NAME_high; none, and no file, where
    they are not determined."""
    known = [index for index, low in enumerate(interval.low) if np.isfinite(low).all()]
    if not known:
        remove(path)
        return
    titles = tuple(f"{names[index]}{end}" for index in known for end in ("_low", "_high"))
    ends = np.stack([values[index] for index in known for values in (interval.low, interval.high)])
    write_spectra_csv(path, SpectraTable(bands, titles, ends))


def write_endmembers(folder: Path, materials: Materials, interval: Interval) -> None:
    """Write the endmembers as CSV (wavelength in nm, a column a spectrum) and the same of the ends of their intervals,
    ENVI spectral library and plot."""
    table_path, intervals_path, *_, plot_path = _endmember_paths(make_folder(folder))
    spectra = materials.endmembers.detach().cpu().numpy().astype(np.float32)
    about = f"endmembers: {materials.quantity}, 1 = full scale"
    write_envi_library(folder / "endmembers", spectra, materials.bands, materials.names, about)
    write_spectra_csv(table_path, materials.table())
    write_intervals(intervals_path, materials.bands, materials.names, interval)
    under = "reflectance" if materials.quantity == "reflectance" else "radiance under the scene's light"
    labels = ("wavelength (nm)", f"{under} (1 = full scale)")
    colours = endmember_colours(materials)
    write_file(
        plot_path,
        draw_spectra(spectra, materials.bands.centers_nm, materials.names, colours, labels, interval),
    )


def draw_spectra(
    spectra: Float[np.ndarray, "K B"],
    x: Shaped[np.ndarray, " B"],
    names: Sequence[str],
    colours: Float[np.ndarray, "K 3"],
    labels: tuple[str, str],
    interval: Interval | None = None,
) -> bytes:
    """Endmembers as lines over wavelengths or numbers of bands, as a PNG, with their intervals where they are known;
    from the ninth on, dashes tell near colours apart too. `labels` are those of both axes."""
    from matplotlib.figure import Figure

    legend_columns = -(-len(colours) // _LEGEND_ROWS)
    figure = Figure(figsize=(7.2 + 1.5 * legend_columns, 4.6), layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    for index, (spectrum, colour) in enumerate(zip(spectra, colours, strict=True)):
        axes.plot(
            x,
            spectrum,
            color=tuple(colour),
            linestyle=_LINE_STYLES[index // 8 % len(_LINE_STYLES)],
            linewidth=2.0,
            marker="o" if len(x) <= 40 else None,
            markersize=3.5,
            label=plot_text(names[index]),
        )
        if interval is not None and np.isfinite(interval.low[index]).all():
            ends = (interval.low[index], interval.high[index])
            axes.fill_between(x, *ends, color=tuple(colour), alpha=0.15, linewidth=0)
    axes.set(xlabel=plot_text(labels[0]), ylabel=plot_text(labels[1]))
    axes.set_ylim(bottom=0.0)
    axes.set_title("Endmembers", loc="left", fontweight="bold")
    plain_axes(axes)
    figure.legend(loc="outside right upper", ncols=legend_columns, frameon=False)
    return figure_bytes(figure)
