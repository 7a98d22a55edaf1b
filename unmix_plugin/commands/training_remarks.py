"""What the course of the loss says of a training, in words: whether it settled, and what to try where it did not."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from unmix_plugin.errors import counted

_FEWEST_LINES = 8
"""Lines of metrics below which nothing is said."""
_DOUBTED = 0.02
"""Share of poses that are not believed, of which more is said."""
_HARDLY_FELL = 0.6
"""Loss in the last quarter of the training, over that in the first, above which it hardly fell. Trainings that settle
stay below 0.35, also short ones."""
_STILL_FALLS = 0.3
"""Share by which the loss fell from the third to the last quarter, above which more steps are worthwhile."""


def read_remarks(metrics_path: Path) -> list[str]:
    """Remarks on the training whose `metrics.jsonl` this is; none where the file can't be read."""
    try:
        lines = [json.loads(line) for line in metrics_path.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError):
        return []
    return remarks([line for line in lines if line.get("split") == "train"])


def remarks(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Sentences for whoever trains.

    Args:
        lines: Of training batches in order, each with `step` and `loss` (None where it was not finite).
    """
    known = [line for line in lines if line.get("loss") is not None]
    if len(known) < _FEWEST_LINES:
        return []
    first, third, last = (_typical_loss(known, quarter) for quarter in (1, 3, 4))
    if None in (first, third, last) or not first or not third or last is None:
        return []
    found = []
    undone = int(known[-1].get("poses_undone") or 0)
    if undone:
        found.append(
            f"corrections of the poses of {counted(undone, 'view')} went beyond a quarter of the distance to the scene "
            "(or 14 degrees) and were undone: look whether these views belong to the scene, or train with --poses fixed"
        )
    doubted = float(known[-1].get("poses_doubted") or 0)
    if doubted > _DOUBTED:
        found.append(
            f"{doubted:.0%} of the views, or of the rows of line cameras, still fit far worse than the others and "
            "hardly shape the scene: their poses are off by more than was found, or they show something else"
        )
    if last > _HARDLY_FELL * first:
        found.append(
            f"the loss hardly fell: in the last quarter of the training it was {last / first:.0%} of that in the "
            "first. The views don't agree on one scene. Look at the pictures of unmix-eval: double edges mean wrong "
            "poses; blurred brightness, a light that moves (try --light camera, or --light per-view where exposures "
            "differ); bright specks, blown-out pixels or background within the masks"
        )
    elif 1 - last / third > _STILL_FALLS:
        found.append(
            f"the loss still fell by {1 - last / third:.0%} from the third to the last quarter: a longer training "
            "(--max-num-iterations, --max-seconds) will show more"
        )
    return found


def _typical_loss(lines: Sequence[Mapping[str, Any]], quarter: int) -> float | None:
    """Median over a quarter of the lines' time, 1 to 4; None without lines in it."""
    start, end = (lines[at]["step"] for at in (0, -1))
    low, high = (start + (end - start) * part / 4 for part in (quarter - 1, quarter))
    losses = [float(line["loss"]) for line in lines if low < line["step"] <= high]
    return median(losses) if losses else None
