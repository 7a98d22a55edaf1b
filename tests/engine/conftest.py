"""What the engine's tests share: the second method, registered, and short configs of it."""

import importlib.metadata
from dataclasses import replace
from pathlib import Path

import pytest

from tests.engine.rgb_nerf_plugin import rgb_nerf
from unmix_plugin.engine import registry
from unmix_plugin.engine.configs import TrainerConfig

RGB_NERF_ENTRY = importlib.metadata.EntryPoint(
    "rgb-nerf", "tests.engine.rgb_nerf_plugin:rgb_nerf", registry.METHOD_GROUP
)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch):
    """Entry points found in place of the installed ones; a test may append to the list."""
    entries = [RGB_NERF_ENTRY]
    monkeypatch.setattr(registry, "entry_points", lambda group: [e for e in entries if e.group == group])
    return entries


@pytest.fixture
def short_config(tmp_path: Path, registered: list) -> TrainerConfig:  # noqa: ARG001
    """Twelve steps of the second method."""
    scene = tmp_path / "ball"
    scene.mkdir()
    return replace(
        rgb_nerf.config,
        data=scene,
        output_dir=tmp_path / "outputs",
        max_num_iterations=12,
        steps_per_save=4,
        steps_per_log=1,
        device="cpu",
    )
