"""Runs side by side: figures with their differences, errors by view and band, pictures one above the other.

What is compared is what the runs share: evaluation views of one name that show the same measurements, and bands of one
wavelength.

Notation: `V` evaluation views, `S` bands that a view has in all runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from unmix_plugin.engine.runs.replacing import remove
from unmix_plugin.errors import ConfigError, counted
from unmix_plugin.figures.pictures import one_above_the_other
from unmix_plugin.formats.files import csv_bytes, write_file
from unmix_plugin.trained.evaluation import BandErrors

_SAME_NM = 0.01
"""Difference of wavelengths below which bands are the same."""
_SAME_MEAN = 1e-4
"""Relative difference of a band's mean over a view below which measurements are the same."""
_Row = tuple[str, list[Any]]
"""What is compared, and its value in each run."""


@dataclass(frozen=True)
class ComparedRun:
    """What was found of one run."""

    path: Path
    method: str
    figures: dict[str, Any]
    """By name; None where there is no truth."""
    views: dict[str, dict[str, Any]]
    """Figures of each view, by its name."""
    bands: dict[str, BandErrors]
    """Of each view; empty where the model measured its images itself."""
    cameras: Float[np.ndarray, "V 3 4"]
    """Camera to model space, of the evaluation views."""
    pictures: Path
    """Holds KIND/NAME.png."""
    settings: dict[str, Any]
    """By dotted name."""
    aligned: tuple[str, ...] = ()
    """What of each view was fitted to the measured one first: `gain`, `pose`."""


@dataclass(frozen=True)
class Comparison:
    """Runs side by side."""

    labels: list[str]
    """Of each run, what tells its path from the others."""
    rows: list[_Row]
    """Settings that differ, then figures."""
    remarks: list[str]
    """What is left out, and why."""
    num_pictures: int


def compare_runs(runs: Sequence[ComparedRun], folder: Path) -> Comparison:
    """Compare, and write figures.csv, views.csv, band_rmse.csv and KIND/NAME.png.

    Raises:
        ConfigError: methods that measure differently, or nothing that the runs share.
    """
    labels, remarks = _labels([run.path for run in runs]), []
    blank = {name for run in runs for name, errors in run.bands.items() if not errors.num_pixels}
    if blank:
        remarks.append(f"left out: {counted(len(blank), 'view')} without a valid pixel")
        runs = [_without_blank(run) for run in runs]
    first, names = runs[0], _shared_views(runs, remarks)
    if len({run.aligned for run in runs}) > 1:
        fitted = [
            f"{label}: {' and '.join(run.aligned) or 'nothing'}"
            for label, run in zip(labels, runs, strict=True)
        ]
        remarks.append(
            f"not measured alike: fitted to each evaluation view first were, of {'; '.join(fitted)}"
        )
    bands = {name: _shared_bands([run.bands[name] for run in runs]) for name in names if first.bands}
    squared = {
        name: np.stack([run.bands[name].mse[rows] for run, rows in zip(runs, at, strict=True)], axis=1)
        for name, (_, at) in bands.items()
    }
    has_more_views = any(len(run.views) > len(names) for run in runs)
    if has_more_views or any(len(run.bands[name].nm) > len(bands[name][0]) for run in runs for name in bands):
        num_bands = max(len(nm) for nm, _ in bands.values())
        shared = f"{counted(len(names), 'view')} and {counted(num_bands, 'band')}"
        remarks.append(f"runs differ in views or bands: psnr and rmse of what they share alone, {shared}")
        of_views = np.stack([errors.mean(axis=0) for errors in squared.values()])
        figures: list[_Row] = [
            ("psnr", (-10 * np.log10(of_views.clip(1e-12))).mean(axis=0).tolist()),
            ("rmse", np.sqrt(of_views).mean(axis=0).tolist()),
        ]
    else:
        figures = _rows([run.figures for run in runs])
    settings = _rows([run.settings for run in runs])
    rows = [row for row in settings if any(value != row[1][0] for value in row[1])] + figures
    errors = [
        (name, f"{nm:g}", np.sqrt(row).tolist())
        for name, (centers, _) in bands.items()
        for nm, row in zip(centers, squared[name], strict=True)
    ]
    views = [(name, *row) for name in names for row in _rows([run.views[name] for run in runs])]
    for file, keys, table in (
        ("figures", ["figure"], rows),
        ("views", ["view", "figure"], views),
        ("band_rmse", ["view", "wavelength_nm"], errors),
    ):
        lines = [[*keys, *labels, *(f"{label} minus {labels[0]}" for label in labels[1:])]]
        for *keyed, values in table:
            differences = (difference(one, values[0]) for one in values[1:])
            lines.append([*keyed, *map(shown, values), *differences])
        write_file(folder / f"{file}.csv", csv_bytes(lines))
    return Comparison(labels, rows, remarks, _write_pictures(runs, names, labels, folder))


def _write_pictures(
    runs: Sequence[ComparedRun], names: Sequence[str], labels: Sequence[str], folder: Path
) -> int:
    """Pictures that all runs have, one above the other, in place of earlier ones of ours; and how many there are."""
    remove(*folder.glob("*/*.png"))
    drawn = 0
    for kind in sorted({path.parent.name for path in runs[0].pictures.glob("*/*.png")}):
        for name in names:
            pictures = [run.pictures / kind / f"{name}.png" for run in runs]
            if all(path.is_file() for path in pictures):
                page = one_above_the_other(pictures, [f"run {label}" for label in labels])
                write_file(folder / kind / f"{name}.png", page)
                drawn += 1
    return drawn


def shown(value: Any) -> str:
    """A value in a table; nothing for None."""
    return "" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)


def difference(value: Any, reference: Any) -> str:
    """With its sign; empty where one of them is no number.

    >>> difference(0.5, 0.75), difference(None, 0.5)
    ('-0.25', '')
    """
    known = all(isinstance(one, int | float) and not isinstance(one, bool) for one in (value, reference))
    return f"{value - reference:+.4g}" if known else ""


def _rows(runs: Sequence[dict[str, Any]]) -> list[_Row]:
    """What some run knows."""
    names = dict.fromkeys(name for run in runs for name in run if name != "name")
    rows = [(name, [run.get(name) for run in runs]) for name in names]
    return [row for row in rows if any(value is not None for value in row[1])]


def _labels(paths: Sequence[Path]) -> list[str]:
    """What tells each path from the others: as few as possible of the parts that differ, from the left.

    >>> _labels([Path("/sweep/4/demo/unmix-nerf/a"), Path("/sweep/6/demo/unmix-nerf/b")])
    ['4', '6']
    """
    depth = max(len(path.parts) for path in paths)
    parts = [[*path.parts, *[""] * (depth - len(path.parts))] for path in paths]
    differ = [at for at in range(depth) if len({own[at] for own in parts}) > 1]
    for count in range(1, len(differ) + 1):
        labels = ["/".join(filter(None, (own[at] for at in differ[:count]))) for own in parts]
        if len(set(labels)) == len(labels):
            return labels
    return [str(path) for path in paths]


def _without_blank(run: ComparedRun) -> ComparedRun:
    """The run without views of no valid pixel, which have no errors and no part in its figures."""
    bands = {name: errors for name, errors in run.bands.items() if errors.num_pixels}
    if not bands:
        raise ConfigError(f"{run.path}: no evaluation view has a valid pixel")
    return replace(run, views={name: run.views[name] for name in bands}, bands=bands)


def _shared_views(runs: Sequence[ComparedRun], remarks: list[str]) -> list[str]:
    """Names of the views that show the same in all runs; what is said of the others goes to the remarks."""
    first = runs[0]
    for other in runs[1:]:
        if bool(other.bands) != bool(first.bands):
            raise ConfigError(
                f"{first.path} is of {first.method}, {other.path} of {other.method}: these measure views differently; "
                "compare runs of methods that measure alike. The spectra of any method are measured as those of "
                "unmix-nerf where its model names them: an Output of kind channels with a quantity"
            )
    names = [name for name in first.views if all(name in run.views for run in runs)]
    others = len({name for run in runs for name in run.views}) - len(names)
    if others:
        remarks.append(f"left out: {counted(others, 'view')} that not all runs have")
    if first.bands:
        banded = [name for name in names if len(_shared_bands([run.bands[name] for run in runs])[0])]
        if names and not banded:
            raise ConfigError("the runs share no band: all their wavelengths differ")
        if len(banded) < len(names):
            remarks.append(f"left out: {counted(len(names) - len(banded), 'view')} without a shared band")
        names = banded
        same = [name for name in names if _is_same([run.bands[name] for run in runs])]
    else:
        poses = [run.cameras for run in runs]
        alike = all(one.shape == poses[0].shape and np.allclose(one, poses[0], atol=1e-4) for one in poses)
        same = names if alike and not others else []
    if len(same) < len(names):
        remarks.append(
            f"left out: {counted(len(names) - len(same), 'view')} of one name with other measurements"
        )
    if not same:
        paths = " and ".join(str(run.path) for run in runs)
        raise ConfigError(
            f"{paths} are runs of different scenes: no evaluation view shows the same in all of them"
        )
    return same


def _shared_bands(views: Sequence[BandErrors]) -> tuple[Float[np.ndarray, " S"], list[Int[np.ndarray, " S"]]]:
    """Wavelengths that all have, nm, and where each has them."""
    first = views[0].nm
    distances = [np.abs(view.nm - first[:, None]) for view in views]
    kept = np.logical_and.reduce([distance.min(axis=1) < _SAME_NM for distance in distances])
    return first[kept], [distance.argmin(axis=1)[kept] for distance in distances]


def _is_same(views: Sequence[BandErrors]) -> bool:
    """Whether a view was measured alike: as many pixels, with the same mean in every band that all have."""
    means = [view.mean[rows] for view, rows in zip(views, _shared_bands(views)[1], strict=True)]
    return len({view.num_pixels for view in views}) == 1 and all(
        np.allclose(mean, means[0], rtol=_SAME_MEAN, atol=1e-7) for mean in means
    )
