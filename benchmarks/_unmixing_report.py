"""What the unmixing benchmark says of its figures: verdicts and tables."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import _common

OURS = "3d:ours"

SHOWN = {
    "miou": "mIoU",
    "macro_f1": "macro F1",
    "accuracy": "accuracy",
    "abundance_rmse": "abundance RMSE",
    "endmember_angle": "endmember angle",
    "psnr": "PSNR",
    "sam": "spectral angle",
}
"""Columns, and their keys in metrics.json."""

Seeds = dict[str, dict[str, float | None]]
"""Figures by seed."""

_KNOWN = {
    ("2d:oracle, NNLS", "miou"): {"still-life": 0.86, "cbox-sphere": 0.66, "vnir-pots": 0.88},
    ("2d:oracle, NNLS", "abundance_rmse"): {"still-life": 0.075, "cbox-sphere": 0.237, "vnir-pots": 0.079},
    ("2d:oracle, probe", "miou"): {"still-life": 0.59, "cbox-sphere": 0.71, "vnir-pots": 0.70},
}
"""Figures of oracles by scene, found by other code: they check this benchmark."""

_DEVIATION = _common.Limit(0.03, is_upper=True)
_GAIN = _common.Limit(0.03)
_ABUNDANCE_RMSE = _common.Limit(0.16, 0.13, is_upper=True)
_ENDMEMBER_AIM_RAD = 0.06
_PSNR_LOSS_DB = 0.3


@dataclass
class SceneFigures:
    """What was measured of one scene."""

    rows: dict[str, Seeds] = field(default_factory=dict)
    """By name of the row."""
    proposed: dict[str, dict[str, Any]] = field(default_factory=dict)
    """By seed: the `number` of materials proposed, the `true` one, and the evidence."""


def judge(measured: dict[str, SceneFigures]) -> list[_common.Figure]:
    """Whether oracles are the known ones, numbers of materials right, and ours above methods that see single pixels."""
    return [
        *(figure for scene, found in measured.items() for figure in _judge_oracle(scene, found.rows)),
        *(_judge_proposed(scene, found.proposed) for scene, found in measured.items() if found.proposed),
        *(figure for scene, found in measured.items() for figure in _judge_ours(scene, found.rows)),
        *_judge_means([found.rows for found in measured.values() if OURS in found.rows]),
    ]


def tables(measured: dict[str, SceneFigures]) -> list[_common.DetailTable]:
    """Means over scenes of the medians of rows that all have, then every row of each scene."""
    scenes = [found.rows for found in measured.values()]
    common = [name for name in scenes[0] if all(name in rows for rows in scenes)]
    lines = [
        [name, *(f"{_mean(median(rows[name], key) for rows in scenes):.3f}" for key in SHOWN)]
        for name in common
    ]
    means = _common.DetailTable("Mean over scenes", ["row", *SHOWN.values()], lines)
    return [means, *(_scene_table(scene, found.rows) for scene, found in measured.items())]


def median(seeds: Seeds, key: str = "miou") -> float:
    """Over seeds; not a number where a seed has no such figure."""
    values = [_number(figures.get(key)) for figures in seeds.values()]
    return math.nan if any(map(math.isnan, values)) else statistics.median(values)


def deviation(seeds: Seeds) -> float:
    """Standard deviation of mIoU over seeds; 0 of one."""
    values = [_number(figures.get("miou")) for figures in seeds.values()]
    return statistics.stdev(values) if len(values) > 1 else 0.0


def best_pixel_row(rows: dict[str, Seeds], finder: Literal["theirs", "ours"] = "theirs") -> str | None:
    """The 2-D row of largest mIoU that is not an oracle.

    Args:
        finder: Whether endmembers are found by known methods or by searches of ours, which are half of what is judged.
    """
    fair = [name for name in rows if name.startswith("2d:") and "oracle" not in name]
    fair = [name for name in fair if name.startswith(("2d:pairs", "2d:pooled")) == (finder == "ours")]
    return max(fair, key=lambda name: median(rows[name]), default=None)


def _judge_oracle(scene: str, rows: dict[str, Seeds]) -> list[_common.Figure]:
    return [
        _common.required(
            f"{scene}: {SHOWN[key]} of {row.removeprefix('2d:')}",
            f"{expected[scene]:g} within 0.01",
            abs(median(rows[row], key) - expected[scene]) <= 0.01,
            f"{median(rows[row], key):.4g}",
        )
        for (row, key), expected in _KNOWN.items()
        if row in rows and scene in expected
    ]


def _judge_proposed(scene: str, proposed: dict[str, dict[str, Any]]) -> _common.Figure:
    true = next(iter(proposed.values()))["true"]
    numbers = [found["number"] for found in proposed.values()]
    return _common.required(
        f"{scene}: number of materials proposed, by seed",
        f"{true} within 1",
        all(abs(number - true) <= 1 for number in numbers),
        ", ".join(map(str, numbers)),
    )


def _judge_ours(scene: str, rows: dict[str, Seeds]) -> list[_common.Figure]:
    best = best_pixel_row(rows)
    if best is None:
        return []
    named = {"best 2-D row": best, "best 2-D row with the endmembers of ours": best_pixel_row(rows, "ours")}
    figures = [
        _common.reported(f"{scene}: {what}", f"{row}, mIoU {median(rows[row]):.3f}")
        for what, row in named.items()
        if row is not None
    ]
    if OURS in rows:
        limit = _common.Limit(round(median(rows[best]), 3))
        figures.append(limit.judge(f"{scene}: mIoU of ours", median(rows[OURS])))
        if len(rows[OURS]) > 1:
            spread = deviation(rows[OURS])
            figures.append(_DEVIATION.judge(f"{scene}: deviation of its mIoU over seeds", spread))
        best_psnr = max(median(seeds, "psnr") for name, seeds in rows.items() if name.startswith("3d:"))
        limit = _common.Limit(round(best_psnr - _PSNR_LOSS_DB, 2), unit=" dB")
        figures.append(
            limit.judge(
                f"{scene}: PSNR of ours, the best 3-D row's less {_PSNR_LOSS_DB}", median(rows[OURS], "psnr")
            )
        )
    return figures


def _judge_means(scenes: list[dict[str, Seeds]]) -> list[_common.Figure]:
    """The lines about means over the scenes that ours was trained on."""
    if not scenes:
        return []
    gains = [median(rows[OURS]) - median(rows[best]) for rows in scenes if (best := best_pixel_row(rows))]
    figures = (
        [_GAIN.judge("mIoU of ours above the best 2-D row, mean over scenes", _mean(gains))] if gains else []
    )
    rmse = _mean(median(rows[OURS], "abundance_rmse") for rows in scenes)
    figures.append(_ABUNDANCE_RMSE.judge("abundance RMSE of ours, mean over scenes", rmse))
    if all("2d:VCA, NNLS" in rows for rows in scenes):
        corners = _mean(median(rows["2d:VCA, NNLS"], "endmember_angle") for rows in scenes)
        limit = _common.Limit(round(corners, 3), _ENDMEMBER_AIM_RAD, is_upper=True, unit=" rad")
        angle = _mean(median(rows[OURS], "endmember_angle") for rows in scenes)
        figures.append(limit.judge("endmember angle of ours against VCA's, mean over scenes", angle))
    return figures


def _scene_table(scene: str, rows: dict[str, Seeds]) -> _common.DetailTable:
    lines = [
        [name, str(len(seeds)), f"{median(seeds):.3f} ± {deviation(seeds):.3f}"]
        + [f"{median(seeds, key):.3f}" for key in SHOWN if key != "miou"]
        for name, seeds in rows.items()
    ]
    return _common.DetailTable(scene, ["row", "seeds", *SHOWN.values()], lines)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _mean(values: Iterable[float]) -> float:
    return statistics.fmean(values)
