"""How near do methods that unmix single pixels come to an image's true abundances and endmembers?

    python benchmarks/unmixing_2d.py FILE.mat --endmembers 3 --seeds 5 [--json]
    python benchmarks/unmixing_2d.py SCENE_FOLDER [--seeds 5] [--json]
    python benchmarks/unmixing_2d.py samson_dataset.mat --results benchmarks/results --variant samson

A .mat file holds `Y` (B, N) or (H, W, B), the pixels, `A` (K, N), their true abundances, and `M` (B, K), the true
endmembers, any of them transposed. Y may be in any unit, M of any brightness. All methods get the same draws, pixels
and brightness; endmembers are matched to the true ones by spectral angle. Printed are, over seeds, the median, the
spread (largest less smallest) and the standard deviation of the abundance RMSE over all pixels and materials and of the
mean endmember angle in radians; of scene folders, which need labels and true spectra, mIoU too. The row `pooled, NNLS`
is the product's own: `unmix_image` with its defaults. Bad input ends with one message and exit
code 2.
"""

from __future__ import annotations

import json
import statistics
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import _common  # settles how threads wait, which must be before torch is imported
import _machine
import tyro
from _unmixing_mat import PixelImage, read_mat
from _unmixing_methods import METHODS, OURS, PixelMethod
from rich.console import Console
from rich.table import Table

from unmix_plugin.errors import SceneError, SpectrumError, UnmixError

LIMITS = {
    "abundance_rmse": _common.Limit(0.03, is_upper=True),
    "endmember_angle": _common.Limit(0.035, is_upper=True, unit=" rad"),
}
"""Of the product's own method, on Samson."""


@dataclass(frozen=True)
class Options:
    """Unmix an image by each method."""

    file: Annotated[Path, tyro.conf.Positional]
    """A .mat file, or a scene folder."""
    endmembers: int | None = None
    """How many to find; None: as many as there are true ones. Any other number is refused."""
    seeds: int = 5
    """Number of seeds, from 0."""
    rows: tuple[str, ...] = ()
    """Names of methods; all if none is given."""
    json: bool = False
    """Print JSON."""
    results: Path | None = None
    """Folder for unmixing_2d-VARIANT.json and .md; None: nothing is written."""
    variant: str = ""
    """What names the files; the file's own name if none is given."""


@dataclass(frozen=True)
class Summary:
    """A figure over seeds."""

    median: float
    spread: float
    """Largest less smallest."""
    standard_deviation: float
    values: list[float]
    """By seed."""


def main(options: Options) -> None:
    """Measure and print."""
    methods = measure(options)
    if options.json:
        report = {
            "file": options.file.name,
            "seeds": options.seeds,
            "spread": "largest less smallest over seeds",
            "product": OURS,
            "methods": {
                name: {key: asdict(summary) for key, summary in figures.items()}
                for name, figures in methods.items()
            },
        }
        print(json.dumps(report, indent=1))
        return
    if options.results is not None:
        _common.publish(_report(options, methods), options.results)
        return
    headers = ["method"]
    for key in next(iter(methods.values())):
        headers += [f"{key}: median", "spread", "std"]
    table = Table(*headers, title=f"{options.file.name}: {options.seeds} seeds; {OURS} is the product's own")
    for name, figures in methods.items():
        cells = [(s.median, s.spread, s.standard_deviation) for s in figures.values()]
        table.add_row(name, *(f"{value:.4f}" for cell in cells for value in cell))
    Console().print(table)


def _report(options: Options, methods: dict[str, dict[str, Summary]]) -> _common.Report:
    """What is written: figures of the product's own method, and a table of all."""
    own = methods.get(OURS, {})
    figures = [
        LIMITS[key].judge(f"{OURS}: {key.replace('_', ' ')}, median", own[key].median)
        if key in LIMITS
        else _common.reported(f"{OURS}: {key.replace('_', ' ')}, median", f"{own[key].median:.4f}")
        for key in own
    ]
    keys = list(next(iter(methods.values())))
    headers = ["method", *(word for key in keys for word in (key.replace("_", " "), "spread", "std"))]
    rows = [
        [name, *(f"{v:.4f}" for s in found.values() for v in (s.median, s.spread, s.standard_deviation))]
        for name, found in methods.items()
    ]
    setting = {
        "file": options.file.name,
        "seeds": options.seeds,
        "spread": "largest less smallest over seeds",
    }
    measured = {
        name: {key: asdict(summary) for key, summary in found.items()} for name, found in methods.items()
    }
    table = _common.DetailTable("Medians over seeds", headers, rows)
    question = "Single pixels of an image with known abundances; angles in radians"
    machine, variant = _machine.describe_machine(), options.variant or options.file.stem
    return _common.Report("unmixing_2d", question, setting, machine, figures, measured, (table,), variant)


def measure(options: Options) -> dict[str, dict[str, Summary]]:
    """Figures over seeds of each method.

    Raises:
        UnmixError: no such file or row, no true materials, or another number of them.
    """
    unknown = [row for row in options.rows if row not in METHODS]
    if unknown:
        raise SceneError(f"no method is called {unknown[0]!r}; take any of: {'; '.join(METHODS)}")
    if options.seeds < 1:
        raise SceneError(f"--seeds must be at least 1; found {options.seeds}")
    image = _open(options.file)
    if options.endmembers not in (None, image.num_materials):
        raise SceneError(
            f"{options.file}: there are {image.num_materials} true materials to compare with; found --endmembers "
            f"{options.endmembers}; ask for {image.num_materials}"
        )
    measured: dict[str, dict[str, Summary]] = {}
    for name in options.rows or METHODS:
        method = METHODS[name]
        seeds = range(1 if method.is_oracle else options.seeds)
        try:
            measured[name] = _summaries([image.score(method, seed) for seed in seeds])
        except SpectrumError as error:
            print(f"left out: {name}: {error}", file=sys.stderr)
    if not measured:
        raise SceneError(f"{options.file}: no method can unmix this image")
    return measured


def _open(path: Path) -> PixelImage | _Views:
    if path.is_dir():
        return _Views(path)
    if not path.is_file():
        raise SceneError(f"there is no file or folder {path}")
    return PixelImage(*read_mat(path))


class _Views:
    """A scene folder, scored on its evaluation views."""

    def __init__(self, folder: Path) -> None:
        from _unmixing_2d import PixelBaselines

        from unmix_plugin.scenes.reading.loader import load_scene
        from unmix_plugin.settings import SceneOptions

        self._baselines = PixelBaselines(load_scene(folder, SceneOptions()))
        if self._baselines.truth.endmembers is None:
            raise SceneError(f"{folder} has no true spectra to compare with")
        self.num_materials = self._baselines.truth.num_materials

    def score(self, method: PixelMethod, seed: int) -> dict[str, float]:
        """Of all evaluation views; see `PixelBaselines.score`."""
        figures = self._baselines.score(method, seed)
        return {key: figures[key] for key in ("abundance_rmse", "endmember_angle", "miou")}


def _summaries(scores: list[dict[str, float]]) -> dict[str, Summary]:
    by_key = {key: [score[key] for score in scores] for key in scores[0]}
    return {
        key: Summary(statistics.median(values), max(values) - min(values), statistics.pstdev(values), values)
        for key, values in by_key.items()
    }


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, description=__doc__))
    except UnmixError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
