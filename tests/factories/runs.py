"""A tiny trained run, words to export of it, and a run whose scene is gone."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from tests.factories.commands import SMALL_METHOD, Ended, done, run_of
from unmix_plugin.commands.export import PRODUCTS
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


def lose_scene(run: Path, scene: Path) -> None:
    """Let a copy of a run say that its scene is in a folder that is not there."""
    for name in ("config.json", "scene.json"):
        text = (run / name).read_text(encoding="utf-8")
        gone = text.replace(json.dumps(str(scene))[1:-1], json.dumps(str(run / "gone"))[1:-1])
        assert gone != text
        (run / name).write_text(gone, encoding="utf-8")


EXPORT_WORDS = {
    "cubes": ["--formats", "envi", "exr", "npy"],
    "mesh": ["--formats", "ply", "obj", "glb", "--resolution", 24],
    "page": ["--resolution", 24, "--title", "pots </script><b>"],
    "point-cloud": ["--num-points", 500],
    "splats": ["--megabytes", 0.05, "--steps", 20],
    "report": ["--max-views", 1],
    "spectrum": ["--view", "eval_002", "--pixel", "8,8"],
    "volume": ["--resolution", 8],
}


PRODUCT_NAMES = [product.name for product in PRODUCTS if isinstance(product, RunProduct)]


def export_words(name, *more):
    return [name, *EXPORT_WORDS.get(name, []), "--device", "cpu", *more]
