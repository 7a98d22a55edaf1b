"""Settings of a whole training run: the root of what the command line and `config.json` spell out."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from unmix_plugin.engine.instantiate import Common, InstantiateConfig, Target, require_in_range
from unmix_plugin.engine.pipeline import PipelineConfig
from unmix_plugin.engine.processes.launching import MOST_PROCESSES
from unmix_plugin.engine.training.optimizers import OptimizerConfig
from unmix_plugin.errors import require

__all__ = ["DeviceName", "InstantiateConfig", "OptimizerConfig", "Target", "TrainerConfig"]

DeviceName = Literal["auto", "cpu", "cuda"]
"""`auto` is CUDA where there is one."""


@dataclass(frozen=True)
class MachineConfig:
    """On what to train."""

    num_devices: int = 1
    """Processes that share the rays of each step, on CUDA each on a device of its own, on the CPU each with a part of
    the cores. Several machines: start them with torchrun, which says how many there are."""

    def __post_init__(self) -> None:
        """Refuse impossible numbers.

        Raises:
            ConfigError: out of range.
        """
        require_in_range("machine.num_devices", self.num_devices, 1, MOST_PROCESSES)


@dataclass(frozen=True)
class TrainerConfig:
    """Settings of one training run; `Trainer(config)` runs it."""

    method_name: tyro.conf.Suppress[str] = "unnamed"
    """Name under which the method is registered."""
    data: Annotated[Path | None, Common] = None
    """The scene's folder."""
    output_dir: Annotated[Path, Common] = Path("outputs")
    """Folder under which the run's own folder is made."""
    max_num_iterations: Annotated[int | None, Common] = 20_000
    """Training ends after so many steps (None: no such limit)."""
    max_seconds: Annotated[float | None, Common] = None
    """Training ends after so many seconds of training; reading, compiling, evaluating and saving not counted."""
    seed: Annotated[int, Common] = 42
    """Everything random follows from this."""
    device: Annotated[DeviceName, Common] = "auto"
    """Where to compute; auto takes CUDA where there is one."""
    steps_per_save: int = 1000
    """Save a checkpoint every so many steps; 0: only at the end."""
    steps_per_eval_all_images: int = 0
    """Evaluate all evaluation views every so many steps; 0: never."""
    steps_per_log: int = 50
    """Write losses and metrics to metrics.jsonl every so many steps."""
    checkpoints_kept: int = 2
    """How many of the newest checkpoints stay in the run folder."""
    average_decay: float | None = None
    """Decay a step of the moving average of the parameters with which the run is evaluated and rendered; early in
    training it decays faster, to span at most about a ninth of the steps so far. None: no average."""
    load_run: Annotated[Path | None, Common] = None
    """Run folder to continue instead of starting a new one."""
    machine: MachineConfig = MachineConfig()
    """Devices and processes."""
    pipeline: PipelineConfig = field(default_factory=PipelineConfig)
    """Data and model."""
    optimizers: Mapping[str, OptimizerConfig] = field(default_factory=dict)
    """Settings of the optimiser by parameter group."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a number out of its range, or no limit at all.
        """
        rules = {
            "max-num-iterations of at least 0": self.max_num_iterations is None
            or self.max_num_iterations >= 0,
            "max-seconds above 0 and finite": self.max_seconds is None or 0 < self.max_seconds < math.inf,
            "max-num-iterations or max-seconds": (self.max_num_iterations, self.max_seconds) != (None, None),
            "seed of -2^63 to 2^63 - 1": -(2**63) <= self.seed < 2**63,
            "steps-per-save of at least 0": self.steps_per_save >= 0,
            "steps-per-eval-all-images of at least 0": self.steps_per_eval_all_images >= 0,
            "steps-per-log of at least 1": self.steps_per_log >= 1,
            "checkpoints-kept of at least 1": self.checkpoints_kept >= 1,
            "average-decay in [0, 1)": self.average_decay is None or 0 <= self.average_decay < 1,
            "a file name as method-name": bool(self.method_name) and "/" not in self.method_name,
        }
        require("a training", self, rules)
