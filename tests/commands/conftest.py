"""One tiny trained run for all tests of commands; those that change it work on a copy."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.factories.ball_model import few_rays
from tests.factories.commands import SMALL_METHOD, Ended, done, run_of
from unmix_plugin.commands.export import PRODUCTS, export
from unmix_plugin.commands.train import train
from unmix_plugin.products.product import RunProduct
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
    ended = done(train, "unmix-nerf", *given, *SMALL_METHOD, *words)
    return Trained(run_of(ended), folder / "scene", folder / "outputs", ended)


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """Twenty steps on a demo scene of 16 x 16 pixels, 8 bands, 6 views for training and 2 for evaluation."""
    return small_run(tmp_path_factory.mktemp("trained"), "--steps-per-log=10")


@pytest.fixture(scope="session")
def solid(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A run whose hull is opaque from its first step on, so that there is a surface."""
    words = "--steps-per-log=5", "--pipeline.model.initial-opacity=0.6"
    return small_run(tmp_path_factory.mktemp("solid"), *words)


@pytest.fixture
def run_copy(trained: Trained, tmp_path: Path) -> Path:
    """A copy of the trained run that a test may damage."""
    return Path(shutil.copytree(trained.run, tmp_path / "copy" / "demo" / "unmix-nerf" / trained.run.name))


EXPORT_WORDS = {
    "cubes": ["--formats", "envi", "exr", "npy"],
    "mesh": ["--formats", "ply", "obj", "glb", "--resolution", 24],
    "page": ["--resolution", 24, "--title", "pots </script><b>"],
    "point-cloud": ["--num-points", 500],
    "splats": ["--resolution", 24],
    "report": ["--max-views", 1],
    "spectrum": ["--view", "eval_002", "--pixel", "8,8"],
    "volume": ["--resolution", 8],
}


PRODUCT_NAMES = [product.name for product in PRODUCTS if isinstance(product, RunProduct)]


def export_words(name, *more):
    return [name, *EXPORT_WORDS.get(name, []), "--device", "cpu", *more]


@pytest.fixture
def solid_copy(solid, tmp_path):
    """A copy of the run that a test may damage."""
    return Path(shutil.copytree(solid.run, tmp_path / "copy" / solid.run.name))


@pytest.fixture(scope="session")
def exported(solid, tmp_path_factory):
    """A folder of every product."""
    root = tmp_path_factory.mktemp("exported")
    said = {}
    with few_rays(8_000):
        for name in PRODUCT_NAMES:
            ended = done(export, *export_words(name, "--run", solid.run, "--output", root / name))
            said[name] = ended.out
    return root, said


@pytest.fixture(scope="module")
def coarse_surfaces():
    """Quick surfaces for tests that ask no more of them than that they are there."""
    with few_rays(8_000):
        yield
