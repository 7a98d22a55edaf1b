"""How far can the confidence of a segmentation be trusted?

    python benchmarks/confidence.py --runs FOLDER [FOLDER ...]

For runs of scenes with labels: the share of right pixels among those of about the same confidence, on all evaluation
views; the calibration error, the mean difference of the two, weighted by pixels; and the accuracy when the least
confident pixels are left out. Takes a few seconds a run; runs are those that `benchmarks/quality.py --runs` keeps.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import _common
import _machine
import numpy as np
import tyro

BINS = np.linspace(0, 1, 11)
KEPT_SHARES = (1.0, 0.9, 0.75, 0.5)


@dataclass(frozen=True)
class Options:
    """Compare confidence with accuracy on the evaluation views of runs."""

    runs: tuple[Path, ...]
    """Run folders, of scenes with labels."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to render."""
    results: Path | None = None
    """Folder for confidence.json and confidence.md; None: beside the benchmarks."""


def main(options: Options) -> None:
    """Measure every run and publish."""
    machine = _machine.describe_machine(options.device)
    measured = dict(measure(path, options.device) for path in options.runs)
    figures = [
        _common.reported(f"{name}: {what}", f"{values[key]:.3f}")
        for name, values in measured.items()
        for what, key in (("calibration error", "calibration_error"), ("accuracy of all pixels", "accuracy"))
    ]
    question = "Confidence of the segmentation against how often it is right"
    tables = (reliability(measured), leaving_out(measured))
    report = _common.Report(
        "confidence", question, {"device": options.device}, machine, figures, measured, tables
    )
    _common.publish(report, _common.results_folder(options.results, quick=False))


def measure(path: Path, device: str) -> tuple[str, dict[str, Any]]:
    """Scene name and figures of a run."""
    from unmix_plugin.engine.runs.loading import load_pipeline
    from unmix_plugin.spectral.segmentation import NOTHING_ID
    from unmix_plugin.trained.evaluation import Evaluation, render_view, scene_truth, view_truth
    from unmix_plugin.trained.open_run import require_materials, snapshot

    loaded = load_pipeline(path, device)
    scene, name = loaded.pipeline.datamanager.scene, loaded.config.method_name  # type: ignore[attr-defined]
    trained = require_materials(snapshot(loaded.pipeline.model, name, loaded.record), name)
    evaluation = Evaluation(scene_truth(scene), trained.materials.endmembers)
    confidences, ids, labels = [], [], []
    for index in scene.eval_indices:
        predicted = render_view(trained, scene.cameras[index])
        evaluation.add(view_truth(scene, index), predicted)
        confidence = trained.render(scene.cameras[index], ["confidence"])["confidence"]
        seen = (scene.labels(index) != NOTHING_ID) & (predicted.segmentation.numpy() != NOTHING_ID)
        confidences.append(confidence.cpu().numpy()[seen])
        ids.append(predicted.segmentation.numpy()[seen])
        labels.append(scene.labels(index)[seen])
    matching = evaluation.segmentation().matching
    named = np.vectorize(lambda k: matching.get(int(k), NOTHING_ID))(np.concatenate(ids))
    right = named == np.concatenate(labels)
    return scene.root.name, scores(np.concatenate(confidences), right)


def scores(confidence: np.ndarray, right: np.ndarray) -> dict[str, Any]:
    """Accuracy by confidence, calibration error, and accuracy of the most confident shares."""
    bins = np.clip(np.digitize(confidence, BINS) - 1, 0, len(BINS) - 2)
    by_bin = [
        {
            "pixels": int((bins == k).sum()),
            "confidence": float(confidence[bins == k].mean()) if (bins == k).any() else None,
            "accuracy": float(right[bins == k].mean()) if (bins == k).any() else None,
        }
        for k in range(len(BINS) - 1)
    ]
    error = sum(
        row["pixels"] * abs(row["accuracy"] - row["confidence"]) for row in by_bin if row["pixels"]
    ) / len(confidence)
    order = np.argsort(-confidence, kind="stable")
    kept = {f"{share:.0%}": float(right[order[: round(share * len(order))]].mean()) for share in KEPT_SHARES}
    return {"calibration_error": error, "accuracy": float(right.mean()), "bins": by_bin, "kept": kept}


def reliability(measured: dict[str, dict[str, Any]]) -> _common.DetailTable:
    """Accuracy by confidence, a column a scene."""
    rows = [
        [
            f"{BINS[k]:.1f}-{BINS[k + 1]:.1f}",
            *(
                f"{row['accuracy']:.2f} ({row['pixels']})" if row["pixels"] else "no pixel"
                for row in (values["bins"][k] for values in measured.values())
            ),
        ]
        for k in range(len(BINS) - 1)
    ]
    return _common.DetailTable("Accuracy (pixels) by confidence", ["confidence", *measured], rows)


def leaving_out(measured: dict[str, dict[str, Any]]) -> _common.DetailTable:
    """Accuracy of the most confident pixels, a column a scene."""
    rows = [
        [share, *(f"{values['kept'][share]:.3f}" for values in measured.values())]
        for share in next(iter(measured.values()))["kept"]
    ]
    return _common.DetailTable("Accuracy of the most confident", ["share kept", *measured], rows)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
