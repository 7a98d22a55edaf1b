"""One fit of an object in a process of its own: trained as `unmix-train` does it, then measured as by `unmix-eval`."""

from __future__ import annotations

import json
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import _common
import torch
from jaxtyping import Float
from torch import Tensor, nn

from tools.procedural_objects import seeded_surface
from unmix_plugin.engine.pipeline import average_metrics
from unmix_plugin.neumatex.demo.surfaces import LayeredSurface
from unmix_plugin.neumatex.fit.model import NeumatexModel
from unmix_plugin.neumatex.tracing.neural import NeuralFamily
from unmix_plugin.neumatex.tracing.surface import LOG_VARIANCE_RANGE, Triplane


class OraclePrior(nn.Module):
    """A prior that knows how wrong it is: the logarithm of its squared error at each point as its log-variance.

    N points, P parameters.
    """

    def __init__(self, prior: Triplane, truth: LayeredSurface) -> None:
        super().__init__()
        self.prior, self.truth, self.family = prior, truth, NeuralFamily()

    def parameters_at(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """As of `Triplane`."""
        return self.prior.parameters_at(positions)

    def log_variance(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N P"]:
        """As of `Triplane`."""
        true = self.family.from_layered(self.truth.parameters(positions))
        return (self.parameters_at(positions) - true).square().log().clamp(*LOG_VARIANCE_RANGE)


def measured_fit(words: Sequence[str], oracle_seed: int | None, processes: int = 1) -> dict[str, Any]:
    """Figures of evaluation, seconds and peak memory of one fit.

    Args:
        words: Of `unmix-train`.
        oracle_seed: Of the object, for a fit with an oracle's uncertainty.
        processes: How many fits are under way at once; each then has one thread.
    """
    with tempfile.TemporaryDirectory() as folder:
        found = Path(folder) / "found.json"
        # Each child then starts with everything imported, and without threads.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        child = context.Process(target=_fit, args=(list(words), oracle_seed, processes, found))
        child.start()
        child.join()
        if child.exitcode != 0:
            raise SystemExit(f"a fit ended with {child.exitcode}: {' '.join(words)}")
        return json.loads(found.read_text(encoding="utf-8"))


def _fit(words: list[str], oracle_seed: int | None, processes: int, found: Path) -> None:
    if processes > 1:
        torch.set_num_threads(1)
    trainer = _common.quiet_trainer(words)
    pipeline, model = trainer.pipeline, trainer.pipeline.model
    if oracle_seed is not None:
        assert isinstance(model, NeumatexModel)
        assert model.prior is not None
        model.anchor["triplane"] = OraclePrior(model.prior, seeded_surface(oracle_seed))
    started = time.process_time()
    record = trainer.train()
    cpu_seconds = time.process_time() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    started = time.process_time()
    figures = average_metrics([metrics for _, metrics, _ in pipeline.evaluate_images()])
    measured = {
        **figures,
        "train_seconds": record.train_seconds,
        "train_cpu_seconds": cpu_seconds,
        "evaluation_cpu_seconds": time.process_time() - started,
        "training_peak_gib": peak / 2**20,
    }
    found.write_text(json.dumps(measured), encoding="utf-8")
