"""Every command computes on a GPU what it computes on the CPU: on CUDA, or where that is missing on a stand-in.

What fails here is a tensor left on the wrong device, a generator of the other device, or an implicit copy to the host.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.ball_model import few_rays
from tests.factories.commands import SMALL_METHOD, done, run_of
from tests.factories.objects import trained_on, write_object
from tests.factories.refined_cameras import MIDDLE, box_around, cameras
from tests.gpu.stand_in import StandInTensor, stand_in_gpu
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
"""Enough for updates of the occupancy grid, more rays per pixel, and the specular part."""
SMALL = {
    "mesh": ["--resolution", 12],
    "page": ["--resolution", 12],
    "splats": ["--megabytes", 0.05, "--steps", 3],
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
    for module in ("training.steps", "runs.loading"):
        monkeypatch.setattr(f"unmix_plugin.engine.{module}.resolve_device", lambda _: device)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("gpu") / "scene"
    make_demo_scene(folder, 16, 8, 8)
    return folder


def trained(scene: Path, folder: Path, method: str = "unmix-nerf", *words: str, steps: int = STEPS) -> Path:
    given = ["--data", scene, "--output-dir", folder, "--max-num-iterations", steps, *words]
    # Many rays from the first step, so that 33 steps end alike with other random numbers.
    given += ["--pipeline.datamanager.train-num-rays-per-batch", 2048]
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


def export_small(product: str, run: Path, folder: Path) -> Path:
    """Where the files of a product are."""
    done(export, product, "--run", run, "--output", folder, *SMALL.get(product, []))
    return folder


def numbers_in(path: Path) -> np.ndarray | None:
    """The numbers of a file; None of a format that has other things, too."""
    if path.suffix == ".npy":
        return np.load(path)
    if path.suffix != ".csv":
        return None
    cells = path.read_text(encoding="utf-8").replace("\n", ",").split(",")
    return np.array([float(cell) for cell in cells if re.fullmatch(r"-?[\d.]+(e-?\d+)?", cell)])


def check_same_numbers(here: Path, there: Path, tolerance: float = 2e-3) -> None:
    """That two folders have the same files, with the same numbers."""
    names = sorted(path.relative_to(here) for path in here.rglob("*") if path.is_file())
    assert names
    assert names == sorted(path.relative_to(there) for path in there.rglob("*") if path.is_file())
    for name in names:
        expected, found = numbers_in(here / name), numbers_in(there / name)
        if expected is not None and found is not None:
            np.testing.assert_allclose(found, expected, atol=tolerance, rtol=tolerance, err_msg=str(name))


@pytest.mark.parametrize("product", [one.name for one in PRODUCTS if isinstance(one, RunProduct)])
def test_every_product_of_a_gpu_has_the_numbers_of_the_cpu(product, cpu_run, tmp_path, monkeypatch):
    tolerance = 0.1 if product == "regions" else 2e-3  # its points are drawn by the generator of the device
    with few_rays(2_000):
        here = export_small(product, cpu_run, tmp_path / "here")
        with gpu(monkeypatch):
            check_same_numbers(here, export_small(product, cpu_run, tmp_path / "there"), tolerance)


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


def render_all(run: Path, folder: Path) -> Path:
    """Where every output of a view is, as numbers."""
    outputs = (
        "spectral rgb diffuse specular abundances segmentation material_scores confidence depth accumulation"
    )
    outputs += " band:600nm false-colour:650,550,450 normals"
    words = ["--run", run, "--view", 0, "--output", folder, "--formats", "npy"]
    done(render, *words, "--outputs", *outputs.split())
    return folder


def test_every_output_of_a_gpu_has_the_numbers_of_the_cpu(cpu_run, tmp_path, monkeypatch):
    here = render_all(cpu_run, tmp_path / "here")
    with gpu(monkeypatch):
        check_same_numbers(here, render_all(cpu_run, tmp_path / "there"))


@pytest.mark.usefixtures("on_gpu")
def test_edited_materials_are_rendered_in_another_light_on_a_gpu(cpu_run, tmp_path):
    recipe = tmp_path / "edits.yml"
    edits = "retint: {endmember: 0, colour: '#3366cc'}", "remove: [1]", "gloss: {endmember: 2, scale: 2}"
    recipe.write_text("edits:\n" + "".join(f"  - {edit}\n" for edit in edits))
    words = ["--run", cpu_run, "--view", 0, "--output", tmp_path / "out"]
    done(render, *words, "--outputs", "rgb", "--edits", recipe, "--illuminant", "A")
