"""Rows of the unmixing benchmark that train a field and evaluate it, by the commands that a user would give."""

from __future__ import annotations

import json
from pathlib import Path

import _common

_MODEL = "--pipeline.model"

TRAINED_ROWS: dict[str, list[str]] = {
    "3d:published": [
        *(f"{_MODEL}.field.scale", "per-endmember"),
        *(f"{_MODEL}.field.temperature", "0.4"),
        *(f"{_MODEL}.specular", "full"),
        *(f"{_MODEL}.endmember-init", "vca"),
        *(f"{_MODEL}.segmentation", "probe"),
        *(f"{_MODEL}.losses.spectral", "5"),
        *(f"{_MODEL}.losses.rgb", "1"),
        *(f"{_MODEL}.losses.abundances", "0"),
    ],
    "3d:ours": [],
    "3d:ours, k-means first": [f"{_MODEL}.endmember-init", "kmeans"],
    "3d:ours, VCA first": [f"{_MODEL}.endmember-init", "vca"],
    "3d:ours, N-FINDR first": [f"{_MODEL}.endmember-init", "nfindr"],
    "3d:ours, minimum volume first": [f"{_MODEL}.endmember-init", "minimum-volume"],
    "3d:ours, no guide": [f"{_MODEL}.losses.abundances", "0"],
    "3d:ours, scales per endmember": [f"{_MODEL}.field.scale", "per-endmember"],
    "3d:ours, free specular part": [f"{_MODEL}.specular", "full"],
    "3d:ours, no specular part": [f"{_MODEL}.specular", "none"],
    "3d:ours, probe": [f"{_MODEL}.segmentation", "probe"],
}
"""What `unmix-train unmix-nerf` is given besides the scene, the seed, the time and the number of endmembers.

As published, but with VCA on the pixels of all views, since one may not show every material, and at one of the
temperatures that its authors chose by scene. An ablation changes one thing of ours."""


def train_and_score(
    folder: Path, row: str, seed: int, max_seconds: float | None, device: str, runs: Path
) -> dict[str, float | None]:
    """Figures of one run, as its eval/metrics.json has them; trained to the end if no time is given."""
    materials = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))["materials"]
    print(f"{folder.name}: {row}, seed {seed} ...", flush=True)
    words = ["unmix-nerf", "--data", str(folder), "--output-dir", str(runs), "--device", device]
    words += ["--seed", str(seed), *([] if max_seconds is None else ["--max-seconds", str(max_seconds)])]
    words += [f"{_MODEL}.num-endmembers", str(len(materials)), *TRAINED_ROWS[row]]
    trained = _common.run_command([_common.console_script("unmix-train"), *words])
    _common.run_command([_common.console_script("unmix-eval"), "--run", str(trained.run), "--device", device])
    metrics = json.loads((trained.run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    return {key: value for key, value in metrics.items() if key not in ("definitions", "per_view")}
