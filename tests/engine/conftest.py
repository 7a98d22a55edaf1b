"""What the engine's tests share: the second method, registered, short configs of it, and a run."""

from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from shutil import copytree

import pytest

from tests.factories.rgb_nerf import rgb_nerf
from unmix_plugin.engine import registry
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.trainer import Trainer

RGB_NERF_ENTRY = EntryPoint("rgb-nerf", "tests.factories.rgb_nerf:rgb_nerf", registry.METHOD_GROUP)


@pytest.fixture
def registered(monkeypatch):
    """Entry points found in place of the installed ones; a test may append to the list."""
    entries = [RGB_NERF_ENTRY]
    monkeypatch.setattr(registry, "entry_points", lambda group: [e for e in entries if e.group == group])
    return entries


@pytest.fixture
def short_config(tmp_path, registered):  # noqa: ARG001
    """Twelve steps of the second method."""
    return short_training(tmp_path)


def short_training(folder: Path) -> TrainerConfig:
    scene, out = folder / "ball", folder / "outputs"
    scene.mkdir()
    every = {"max_num_iterations": 12, "steps_per_save": 4, "steps_per_log": 1}
    return replace(rgb_nerf.config, data=scene, output_dir=out, device="cpu", **every)


@pytest.fixture(scope="session")
def trained_once(tmp_path_factory):
    """A finished run that nobody changes."""
    trainer = Trainer(short_training(tmp_path_factory.mktemp("trained")))
    trainer.train()
    return trainer.run.path


@pytest.fixture
def trained(short_config, trained_once):
    """A finished run of its own for each test."""
    return RunFolder(copytree(trained_once, short_config.output_dir / "run"))
