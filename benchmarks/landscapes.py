"""How near do searches for endmembers come in artificial landscapes, at the median and at worst?

    python benchmarks/landscapes.py [--half once] [--seeds 3]

Every method gets the true number of materials of each landscape (`_landscapes.py`) and is scored as in unmixing_2d.py.
Landscapes of the half `choose` may decide about methods; those of `once` are looked at when nothing is chosen any more.
Of each method the table has, over landscapes, the median and the worst tenth of the mean endmember angle, in how many
it is above 0.15 rad, the same of the abundance RMSE, and the spread over seeds (largest less smallest) that nine of
ten landscapes keep to. `--workers` processes share the landscapes.
"""

from __future__ import annotations

import statistics
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import _common
import _machine
import numpy as np
import torch
import tyro
from _landscapes import NUM_LANDSCAPES, landscape
from _unmixing_mat import PixelImage
from _unmixing_methods import METHODS, OURS

from unmix_plugin.errors import SpectrumError

_ROWS = (
    "k-means, NNLS",
    "VCA, NNLS",
    "N-FINDR, NNLS",
    "minimum volume, NNLS",
    "pairs, NNLS",
    OURS,
    "oracle, NNLS",
)
_WORST_TENTH = _common.Limit(0.15, is_upper=True, unit=" rad")
_SPREAD = _common.Limit(0.02, is_upper=True, unit=" rad")
_FAILED_RAD = 0.15


@dataclass(frozen=True)
class Options:
    """Unmix landscapes by each method."""

    half: Literal["choose", "once"] = "choose"
    """Landscapes to choose by, or those to look at once."""
    seeds: int = 3
    """Number of seeds, from 0."""
    rows: tuple[str, ...] = _ROWS
    """Names of methods."""
    workers: int = 1
    """Processes, of one thread each."""
    results: Path | None = None
    """Folder for landscapes-HALF.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """Two landscapes, one seed."""


def main(options: Options) -> None:
    """Measure and publish."""
    numbers = list(range(int(options.half == "once"), NUM_LANDSCAPES, 2))[: 2 if options.quick else None]
    seeds = 1 if options.quick else options.seeds
    jobs = [(number, options.rows, seeds) for number in numbers]
    with ProcessPoolExecutor(options.workers) as pool:
        measured = dict(zip(map(str, numbers), pool.map(_measured, jobs), strict=True))
    means = {row: _over_landscapes(row, measured) for row in options.rows}
    lines = [[row, *(f"{value:.3f}" for value in found.values())] for row, found in means.items()]
    table = _common.DetailTable("Over landscapes", ["method", *next(iter(means.values()))], lines)
    report = _common.Report(
        "landscapes",
        f"Endmembers and abundances of {len(numbers)} artificial landscapes, the half '{options.half}', {seeds} seeds",
        {"half": options.half, "seeds": seeds},
        _machine.describe_machine("cpu"),
        _judged(means),
        measured,
        [table],
        options.half,
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def _measured(job: tuple[int, tuple[str, ...], int]) -> dict[str, Any]:
    """Traits of a landscape and, by method, figures by seed; None where the method refuses."""
    number, rows, seeds = job
    torch.set_num_threads(1)
    scene = landscape(number)
    image = PixelImage(*map(torch.from_numpy, (scene.pixels, scene.abundances, scene.endmembers)))
    scores: dict[str, Any] = {}
    for row in rows:
        method = METHODS[row]
        try:
            scores[row] = [image.score(method, seed) for seed in range(1 if method.is_oracle else seeds)]
        except SpectrumError:
            scores[row] = None
    print(f"landscape {number} done", flush=True)
    return {"traits": scene.traits, "scores": scores}


def _over_landscapes(row: str, measured: dict[str, Any]) -> dict[str, float]:
    scores = [found["scores"][row] for found in measured.values() if found["scores"][row] is not None]
    angles, errors = (
        [[score[key] for score in seeds] for seeds in scores] for key in ("endmember_angle", "abundance_rmse")
    )
    angle, error = ([statistics.median(seeds) for seeds in values] for values in (angles, errors))
    spreads = [max(seeds) - min(seeds) for seeds in angles]
    return {
        "angle: median": statistics.median(angle),
        "worst tenth": float(np.quantile(angle, 0.9)),
        f"above {_FAILED_RAD:g}": sum(value > _FAILED_RAD for value in angle),
        "spread, nine of ten": float(np.quantile(spreads, 0.9)),
        "abundance RMSE: median": statistics.median(error),
        "RMSE: worst tenth": float(np.quantile(error, 0.9)),
        "refused": len(measured) - len(scores),
    }


def _judged(means: dict[str, dict[str, float]]) -> list[_common.Figure]:
    if OURS not in means or "VCA, NNLS" not in means:
        return []
    ours = means[OURS]
    rivals = {row: found for row, found in means.items() if row != OURS and not METHODS[row].is_oracle}
    best = min(found["angle: median"] for found in rivals.values())
    half = _common.Limit(round(means["VCA, NNLS"]["angle: median"] / 2, 4), is_upper=True, unit=" rad")
    return [
        half.judge("median angle against half of VCA's", ours["angle: median"]),
        _common.Limit(round(best, 4), is_upper=True, unit=" rad").judge(
            "median angle against the best of the others", ours["angle: median"]
        ),
        _WORST_TENTH.judge("angle of the worst tenth", ours["worst tenth"]),
        _SPREAD.judge("spread over seeds in nine of ten", ours["spread, nine of ten"]),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
