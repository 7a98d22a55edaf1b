"""A rig from training to evaluation and renders: figures by sensor, every band from every view."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.factories.commands import SMALL_METHOD, done
from tests.factories.scenes import make_rig
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.trained.open_run import load_run


@pytest.fixture(scope="module")
def rig_run(tmp_path_factory):
    root = tmp_path_factory.mktemp("rig")
    folder = make_rig(root / "rig")
    names = [f"images/view_{index}.png" for index in range(6)]
    folder.edit(lambda content: content.update(train_filenames=names[1:4] + names[5:]))
    folder.edit(lambda content: content.update(test_filenames=[names[0], names[4]]))
    words = ["unmix-nerf", "--data", folder.root, "--output-dir", root / "outputs", *SMALL_METHOD]
    ended = done(train, *words, "--max-num-iterations=30", "--endmembers=1", "--viewer.no-enabled")
    return ended.last_line.removeprefix("run: ").strip()


def test_figures_are_given_by_sensor(rig_run):
    done(evaluate, "--run", rig_run)
    metrics = json.loads((Path(rig_run) / "eval/metrics.json").read_text())
    assert list(metrics["per_sensor"]) == ["4-bands-20x16", "small"]
    whole, small = metrics["per_sensor"].values()
    views = {view["name"]: view for view in metrics["per_view"]}
    assert whole["psnr"] == views["view_0"]["psnr"]
    assert small["psnr"] == views["view_4"]["psnr"]
    assert metrics["psnr"] == pytest.approx((whole["psnr"] + small["psnr"]) / 2)
    assert small["psnr"] > 5
    assert small["rgb_psnr"] is None
    assert whole["rgb_psnr"] is not None
    assert metrics["miou"] is not None


def test_every_band_is_rendered_and_exported_from_every_view(rig_run, tmp_path):
    words = ["--outputs", "spectral", "--formats", "npy", "--output", tmp_path / "r"]
    said = " ".join(done(render, "--run", rig_run, *words).out.split())
    assert "the scene's views have several sizes; pictures of a render have one" in said
    shapes = {np.load(path).shape for path in (tmp_path / "r").rglob("*.npy")}
    assert shapes == {(16, 20, 4)}
    for product in ("cubes", "report", "spectrum"):
        words = ["--view", "view_4", "--pixel", "5,4"] if product == "spectrum" else []
        done(export, product, "--run", rig_run, *words)


def test_exported_views_have_their_own_pixels(rig_run, tmp_path):
    """Rendered at the larger size of another view, they would show something else beside each measured pixel."""
    for product in ("cubes", "abundances", "segmentation"):
        formats = ["--formats", "npy"] if product in ("cubes", "abundances") else []
        done(export, product, "--run", rig_run, "--output", tmp_path / product, *formats)
    scene = load_run(rig_run, "cpu").scene
    for view in (one for one in scene.views if one.split == "eval"):
        expected = scene.render(view.camera, ["spectral", "abundances", "segmentation"])
        cube, shares = (np.load(tmp_path / name / f"{view.name}.npy") for name in ("cubes", "abundances"))
        np.testing.assert_array_equal(cube, expected["spectral"])
        np.testing.assert_array_equal(shares, expected["abundances"])
        ids = np.asarray(Image.open(tmp_path / "segmentation/labels" / f"{view.name}.png"))
        np.testing.assert_array_equal(ids, expected["segmentation"])
    sizes = {view.camera.size(0) for view in scene.views if view.split == "eval"}
    assert sizes == {(20, 16), (10, 8)}
