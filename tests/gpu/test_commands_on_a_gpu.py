"""Every command computes on a GPU what it computes on the CPU: on CUDA, or where that is missing on a stand-in.

What fails here is a tensor left on the wrong device, a generator of the other device, or an implicit copy to the host.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from tests.commands.running import SMALL_METHOD, done, run_of
from tests.gpu.stand_in import StandInTensor, stand_in_gpu
from tests.neumatex.factory import trained_on, write_object
from tests.pose_factory import MIDDLE, box_around, cameras
from tests.products.few_rays import few_rays
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import PRODUCTS, export
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.poses.knots import Knots
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.products.product import RunProduct
from unmix_plugin.scenes.demo.scene import make_demo_scene

pytestmark = pytest.mark.slow
HAS_CUDA = torch.cuda.is_available()
STEPS = 33
"""Enough for updates of the occupancy grid, more rays a pixel, and the specular part."""
SMALL = {
    "mesh": ["--resolution", 12],
    "page": ["--resolution", 12],
    "splats": ["--resolution", 12],
    "point-cloud": ["--num-points", 100],
    "report": ["--max-views", 1],
    "spectrum": ["--view", "eval_002", "--pixel", "8,8"],
    "volume": ["--resolution", 8],
}


@contextmanager
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """Context in which commands compute on CUDA where it is, else on the stand-in, whatever they are told; gives its
    device."""
    if HAS_CUDA:
        where = torch.device("cuda", 0)
        _use(where, monkeypatch)
        yield where
        return
    with stand_in_gpu(monkeypatch) as where:
        _use(where, monkeypatch)
        yield where


def _use(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("training.steps", "runs.load_run"):
        monkeypatch.setattr(f"unmix_plugin.engine.{module}.resolve_device", lambda _: device)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("gpu") / "scene"
    make_demo_scene(folder, 16, 8, 8)
    return folder


def trained(scene: Path, folder: Path, method: str = "unmix-nerf", *words: str, steps: int = STEPS) -> Path:
    given = ["--data", scene, "--output-dir", folder, "--max-num-iterations", steps, *words]
    return run_of(done(train, method, *given, "--pipeline.model.initial-opacity", 0.6, *SMALL_METHOD))


@pytest.fixture(scope="module")
def cpu_run(scene, tmp_path_factory) -> Path:
    return trained(scene, tmp_path_factory.mktemp("cpu"))


@pytest.fixture
def on_gpu(monkeypatch):
    with gpu(monkeypatch), few_rays(2_000):
        yield


@pytest.mark.skipif(HAS_CUDA, reason="CUDA refuses by itself")
def test_a_tensor_on_the_cpu_is_refused_beside_one_on_the_gpu(monkeypatch):
    with stand_in_gpu(monkeypatch) as device:
        here = torch.ones(3, device=device)
        assert isinstance(here + 1.0, StandInTensor)
        with pytest.raises(RuntimeError, match="one device"):
            here.add(torch.ones(3))
        with pytest.raises(RuntimeError, match="generator"):
            torch.rand(3, device=device, generator=torch.Generator())
        with pytest.raises(RuntimeError, match="numpy"):
            here.numpy()


@pytest.mark.usefixtures("on_gpu")
def test_training_on_a_gpu_gives_what_the_cpu_gives(scene, cpu_run, tmp_path):
    there = trained(scene, tmp_path)
    for folder in (cpu_run, there):
        done(evaluate, "--run", folder)
    here, found = (json.loads((folder / "eval" / "metrics.json").read_text()) for folder in (cpu_run, there))
    assert found["psnr"] == pytest.approx(here["psnr"], abs=0.5)


@pytest.mark.usefixtures("on_gpu")
@pytest.mark.parametrize("product", [one.name for one in PRODUCTS if isinstance(one, RunProduct)])
def test_every_product_is_exported_from_a_gpu(cpu_run, tmp_path, product):
    words = [product, "--run", cpu_run, "--output", tmp_path / "out", *SMALL.get(product, [])]
    done(export, *words)


@pytest.fixture(scope="module")
def object_run(tmp_path_factory) -> Path:
    folder = write_object(tmp_path_factory.mktemp("object") / "ball")
    return trained_on(folder, "--pipeline.model.prior=none", steps=1)


@pytest.mark.usefixtures("on_gpu")
@pytest.mark.parametrize("words", [["material", "--texture-size", 64], ["page", "--resolution", 4]])
def test_the_material_of_an_object_is_exported_from_a_gpu(object_run, tmp_path, monkeypatch, words):
    monkeypatch.setattr("unmix_plugin.neumatex.export.pbr_fit._STEPS", 1)
    done(export, *words, "--run", object_run, "--output", tmp_path / "out")


@pytest.mark.usefixtures("on_gpu")
def test_the_published_method_trains_on_a_gpu(scene, tmp_path):
    trained(scene, tmp_path, "unmix-nerf-published")


@pytest.mark.usefixtures("on_gpu")
def test_views_with_gains_and_corrected_poses_are_rendered_on_a_gpu(scene, tmp_path):
    words = ("--light", "per-view", "--poses", "refine", "--pipeline.model.pose-refinement.lens", "radial")
    run = trained(scene, tmp_path, "unmix-nerf", *words, steps=12)
    done(render, "--run", run, "--cameras", "dataset-train", "--view", 0, "--output", tmp_path / "out")


def test_poses_of_line_cameras_are_corrected_on_a_gpu(monkeypatch):
    given, knots = cameras(), Knots.of(cameras())
    with gpu(monkeypatch) as device:
        poses, there = PoseRefinement(knots.rows, "radial").to(device), given.to(device)
        poses.begin(knots.positions(given), box_around(MIDDLE), 0.02)
        views = torch.arange(len(given), device=device)
        rays = there.generate_rays(views, torch.full((len(given), 2), 3.5, device=device))
        steps = poses.free_steps()
        moved = poses(rays, there, steps, 1 / poses.robust.weights[poses.nearest_knots(rays)])
        (moved.directions.sum() + poses.penalty(steps)).backward()
        assert poses.steps.grad is not None
        poses.restore_best()
        found = poses.refined(given)
        assert_close(found.camera_to_world, given.camera_to_world, atol=1e-5, rtol=0)


@pytest.mark.usefixtures("on_gpu")
def test_every_output_is_rendered_on_a_gpu(cpu_run, tmp_path):
    outputs = (
        "spectral rgb diffuse specular abundances segmentation material_scores confidence depth accumulation"
    )
    outputs += " pca band:600nm false-colour:650,550,450 normals"
    words = ["--run", cpu_run, "--view", 0, "--output", tmp_path / "out"]
    done(render, *words, "--outputs", *outputs.split())


@pytest.mark.usefixtures("on_gpu")
def test_edited_materials_are_rendered_in_another_light_on_a_gpu(cpu_run, tmp_path):
    recipe = tmp_path / "edits.yml"
    edits = "retint: {endmember: 0, colour: '#3366cc'}", "remove: [1]", "gloss: {endmember: 2, scale: 2}"
    recipe.write_text("edits:\n" + "".join(f"  - {edit}\n" for edit in edits))
    words = ["--run", cpu_run, "--view", 0, "--output", tmp_path / "out"]
    done(render, *words, "--outputs", "rgb", "--edits", recipe, "--illuminant", "A")
