"""One tiny trained run for all tests of commands; those that change it work on a copy."""

import shutil
from pathlib import Path

import pytest

from tests.factories.ball_model import few_rays
from tests.factories.commands import done
from tests.factories.runs import PRODUCT_NAMES, Trained, export_words, small_run
from unmix_plugin.commands.export import export


@pytest.fixture(scope="session")
def trained(made_once) -> Trained:
    """Twenty steps on a demo scene of 16 x 16 pixels, 8 bands, 6 views for training and 2 for evaluation."""
    return made_once("trained", lambda folder: small_run(folder, "--steps-per-log=10"))


@pytest.fixture(scope="session")
def solid(made_once) -> Trained:
    """A run whose hull is opaque from its first step on, so that there is a surface."""
    words = "--steps-per-log=5", "--pipeline.model.initial-opacity=0.6"
    return made_once("solid", lambda folder: small_run(folder, *words))


@pytest.fixture
def run_copy(trained: Trained, tmp_path: Path) -> Path:
    """A copy of the trained run that a test may damage."""
    return Path(shutil.copytree(trained.run, tmp_path / "copy" / "demo" / "unmix-nerf" / trained.run.name))


@pytest.fixture
def solid_copy(solid, tmp_path):
    """A copy of the run that a test may damage."""
    return Path(shutil.copytree(solid.run, tmp_path / "copy" / solid.run.name))


@pytest.fixture(scope="session")
def exported(solid, made_once):
    """A folder of every product, and what was said of each."""

    def export_all(root):
        with few_rays(8_000):
            ended = {
                name: done(export, *export_words(name, "--run", solid.run, "--output", root / name))
                for name in PRODUCT_NAMES
            }
        return root, {name: one.out for name, one in ended.items()}

    return made_once("exported", export_all)


@pytest.fixture(scope="module")
def coarse_surfaces():
    """Quick surfaces for tests that ask no more of them than that they are there."""
    with few_rays(8_000):
        yield
