"""What does the small prior of neumatex know, and does it know how wrong it is?

    python benchmarks/neumatex_prior.py

Objects that were never seen in training, path-traced under built-in lights as training objects are: the error of each
parameter beside that of always saying the mean; how often the truth is within one and two of the prior's standard
deviations; and the error by what the prior said that it would be. Takes a few minutes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import _common
import _machine
import torch
import tyro
from torch import Tensor

from unmix_plugin.neumatex.prior.observations import Observations
from unmix_plugin.neumatex.prior.small import (
    SHIPPED,
    Estimates,
    MaterialName,
    SmallPrior,
    fit_planes,
    read_record,
    read_small_prior,
)
from unmix_plugin.neumatex.tracing.surface import plane_features

NAMES: dict[MaterialName, list[str]] = {
    "neural": [*(f"base colour {c}" for c in "RGB"), *(f"latent {m} {c}" for m in "AB" for c in "RGB")],
    "pbr": [*(f"base colour {c}" for c in "RGB"), "roughness", "metallicity"],
}
EVALUATION_SEED = 1_000_000
"""Training objects have smaller seeds."""
SIGMAS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 1.0)
"""Edges of the bins of the reliability table."""
GAUSSIAN = {1: 0.683, 2: 0.954}


@dataclass(frozen=True)
class Options:
    """Measure the small prior on objects that it was not trained on."""

    objects: int = 32
    """How many."""
    samples: int = 24
    """Paths a point and view."""
    weights: Path = SHIPPED
    """Folder of the prior's weights."""
    quick: bool = False
    """Only show that it works."""
    results: Path | None = None
    """Folder for neumatex_prior.json and .md; None: beside the benchmarks, nowhere after a quick run."""


def main(options: Options) -> None:
    """Measure and publish."""
    torch.set_num_threads(1)
    machine = _machine.describe_machine()
    record = read_record(options.weights)
    measured = measure(options)
    figures = [figure for material in NAMES for figure in figures_of(material, measured[material])]
    figures.append(
        _common.reported(
            "time of a prediction from observations of 640 points, objects fitted together",
            f"{measured['seconds']:.3f} s",
        )
    )
    size = (options.weights / "small.safetensors").stat().st_size
    figures.append(_common.Limit(10.0, is_upper=True, unit=" MB").judge("weights", size / 1e6))
    kept = ("objects", "steps", "processor_seconds", "decoder_sha256")
    setting = {
        "objects": 2 if options.quick else options.objects,
        "paths a point and view": options.samples,
        "first seed": EVALUATION_SEED,
        **{f"training: {name}": record.get(name) for name in kept},
    }
    question = "What the small prior says of materials of unseen objects, beside the truth"
    tables = [table for material in NAMES for table in tables_of(material, measured[material])]
    report = _common.Report("neumatex_prior", question, setting, machine, figures, measured, tables)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def measure(options: Options) -> dict[str, Any]:
    """Figures of both materials."""
    from tools.prior_objects import training_object
    from tools.train_prior import truth_of

    count = 2 if options.quick else options.objects
    prior = read_small_prior("neural", options.weights)
    seeds = range(EVALUATION_SEED, EVALUATION_SEED + count)
    objects = [training_object(seed, samples=options.samples) for seed in seeds]
    observations = Observations(
        **{
            part.name: torch.cat([getattr(one.observations, part.name) for one in objects])
            for part in fields(Observations)
        }
    )
    truths = [truth_of(one) for one in objects]
    measured: dict[str, Any] = {}
    started = time.perf_counter()
    for material in NAMES:
        found = answers_of(prior, observations, material)
        truth = torch.cat([one[material][0] for one in truths])
        measured[material] = scores(material, *found, truth)
    return {**measured, "seconds": (time.perf_counter() - started) / (len(NAMES) * count)}


@torch.no_grad()
def answers_of(
    prior: SmallPrior, observations: Observations, material: MaterialName
) -> tuple[Tensor, Tensor]:
    """Parameters and standard deviations (all points x P) that the planes say, fitted as for a scene."""
    readers = prior.readers_of(material)
    estimates = Estimates(observations.positions, *prior.estimate(prior(observations), material))
    planes = fit_planes(readers, estimates)
    features = [plane_features(*pair) for pair in zip(planes, observations.positions, strict=True)]
    read = torch.cat(features)
    return readers.material(read), (0.5 * readers.log_variance(read)).exp()


def scores(material: MaterialName, predicted: Tensor, deviations: Tensor, truth: Tensor) -> dict[str, Any]:
    """Errors and calibration by parameter, and the reliability over all of them."""
    errors = predicted - truth
    bins = torch.bucketize(deviations, torch.tensor(SIGMAS[1:-1]))
    return {
        "parameters": {
            name: {
                "rmse": float(errors[:, k].square().mean().sqrt()),
                "rmse_of_the_mean": float(truth[:, k].std()),
                "said": float(deviations[:, k].square().mean().sqrt()),
                **{
                    f"within_{s}": float((errors[:, k].abs() < s * deviations[:, k]).float().mean())
                    for s in GAUSSIAN
                },
            }
            for k, name in enumerate(NAMES[material])
        },
        "within": {str(s): float((errors.abs() < s * deviations).float().mean()) for s in GAUSSIAN},
        "base_colour_psnr_db": float(-10 * errors[:, :3].square().mean().log10()),
        "reliability": [
            {
                "count": int((bins == k).sum()),
                "said": float(deviations[bins == k].square().mean().sqrt()),
                "found": float(errors[bins == k].square().mean().sqrt()),
            }
            for k in range(len(SIGMAS) - 1)
        ],
    }


def figures_of(material: MaterialName, measured: dict[str, Any]) -> list[_common.Figure]:
    """The lines of one material."""
    errors = measured["parameters"].values()
    squared, plain = (sum(row[key] ** 2 for row in errors) for key in ("rmse", "rmse_of_the_mean"))
    return [
        _common.reported(f"{material}: base colour", f"{measured['base_colour_psnr_db']:.2f} dB"),
        _common.reported(f"{material}: variance explained, all parameters", f"{1 - squared / plain:.3f}"),
        *(
            _common.reported(
                f"{material}: truth within {sigma} standard deviation{'s' if sigma > 1 else ''} "
                f"(Gaussian: {share})",
                f"{measured['within'][str(sigma)]:.3f}",
            )
            for sigma, share in GAUSSIAN.items()
        ),
    ]


def tables_of(material: MaterialName, measured: dict[str, Any]) -> list[_common.DetailTable]:
    """Parameters one by one, and the reliability."""
    keys = ("rmse", "rmse_of_the_mean", "said", "within_1", "within_2")
    rows = [[name, *(f"{row[key]:.3f}" for key in keys)] for name, row in measured["parameters"].items()]
    headers = ["parameter", "error", "error of the mean", "said", "within 1", "within 2"]
    by_said = [
        [
            f"{low:.2f}-{high:.2f}",
            str(row["count"]),
            *(f"{row[key]:.3f}" if row["count"] else "-" for key in ("said", "found")),
        ]
        for low, high, row in zip(SIGMAS[:-1], SIGMAS[1:], measured["reliability"], strict=True)
    ]
    return [
        _common.DetailTable(f"{material}: root mean squared errors", headers, rows),
        _common.DetailTable(
            f"{material}: error by what was said", ["said", "parameters", "mean said", "mean found"], by_said
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
