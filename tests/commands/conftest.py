"""One tiny trained run for all tests of commands; those that change it work on a copy."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.commands.running import SMALL_METHOD, Ended, run
from unmix_plugin.commands.train import train
from unmix_plugin.scenes.demo.scene import make_demo_scene


@dataclass(frozen=True)
class Trained:
    """A run, its scene, and what training printed."""

    run: Path
    scene: Path
    output_dir: Path
    ended: Ended


def small_run(folder: Path, *words: str) -> Trained:
    """Make the scene and train on it, with further words."""
    make_demo_scene(folder / "scene", 16, 8, 8)
    given = ["--data", folder / "scene", "--output-dir", folder / "outputs", "--max-num-iterations", 20]
    ended = run(train, "unmix-nerf", *given, *SMALL_METHOD, *words)
    assert ended.status == 0, ended.err
    return Trained(Path(ended.last_line.removeprefix("run: ")), folder / "scene", folder / "outputs", ended)


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Twenty steps on a demo scene of 16 x 16 pixels, 8 bands, 6 views for training and 2 for evaluation."""
    return small_run(tmp_path_factory.mktemp("trained"), "--steps-per-log=10")


@pytest.fixture(scope="session")
def solid(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A run whose hull is opaque from its first step on, so that there is a surface."""
    return small_run(
        tmp_path_factory.mktemp("solid"), "--steps-per-log=5", "--pipeline.model.initial-opacity=0.6"
    )


@pytest.fixture
def run_copy(trained: Trained, tmp_path: Path) -> Path:
    """A copy of the trained run that a test may damage."""
    return Path(shutil.copytree(trained.run, tmp_path / "copy" / "demo" / "unmix-nerf" / trained.run.name))
