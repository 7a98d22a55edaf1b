"""The method from the command line on a ball of one colour: train, resume, evaluate, export, render under other light;
fits that begin at the prior."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.commands.running import done, picture_size, refused, run
from tests.neumatex.factory import SMALL, trained_on, write_light, write_object
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.engine import PipelineConfig, load_model
from unmix_plugin.neumatex.export.material import material_paths
from unmix_plugin.neumatex.fit.data_manager import ObjectDataManagerConfig
from unmix_plugin.neumatex.fit.model import _squared_error
from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig
from unmix_plugin.neumatex.fit.trained_object import TrainedObject
from unmix_plugin.trained.open_run import load_run, snapshot

PBR = "--pipeline.model.material=pbr"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 30 steps."""
    return trained_on(write_object(tmp_path_factory.mktemp("neumatex") / "ball"), PBR, steps=30)


def test_evaluation_finds_colour_and_light_again_also_under_a_light_never_seen(trained):
    done(evaluate, "--run", trained, "--device", "cpu")
    figures = json.loads((trained / "eval" / "metrics.json").read_text())
    assert {"psnr", "relit_psnr", "base_colour_psnr", "views", "lights", "train_seconds"} <= set(figures)
    assert (figures["views"], figures["lights"]) == (1, 1)
    assert figures["psnr"] > 22
    assert figures["relit_psnr"] > 22
    # Even light can't tell a metal from what is diffuse, so only light has to be right.
    assert figures["base_colour_psnr"] > 8
    assert figures["base_colour_psnr_scaled"] >= figures["base_colour_psnr"]
    names = [image["name"] for image in figures["per_image"]]
    assert names == ["000", "dim-000", "dim-001"]
    assert picture_size(trained / "eval" / "rgb" / "000.png") == (1058, 546)
    assert picture_size(trained / "eval" / "relit_rgb" / "dim-001.png") == (1058, 546)
    assert picture_size(trained / "eval" / "base_colour" / "000.png") == (1058, 546)


def test_a_resumed_run_ends_where_a_straight_one_does(tmp_path):
    straight = trained_on(write_object(tmp_path / "ball"), PBR, "--steps-per-save=3", steps=6)
    begun = Path(shutil.copytree(straight, tmp_path / "begun"))
    for path in begun.glob("checkpoints/step-000006*"):
        path.unlink()
    done(train, "neumatex", "--load-run", begun, "--max-num-iterations", 6)
    expected, found = (load_model(path, "cpu").model.state_dict() for path in (straight, begun))
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def test_bad_input_ends_with_status_2_and_one_message(tmp_path):
    folder = write_object(tmp_path / "ball")
    (folder / "environment.exr").write_bytes(b"no picture")
    ended = run(train, "neumatex", "--data", folder, "--output-dir", tmp_path / "out", *SMALL, PBR)
    assert ended.status == 2
    assert "environment.exr" in ended.err
    assert len(ended.err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_display_pictures_train_their_response(tmp_path):
    run = trained_on(write_object(tmp_path / "ball", suffix=".png"), PBR, steps=3)
    model = load_model(run, "cpu").model
    assert float(model.get_parameter("curve.coefficients").detach().abs().max()) > 0


def test_the_loss_leaves_the_noise_of_the_render_out():
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(2, 40_000, 3, generator=generator)
    found = torch.ones(40_000, dtype=torch.bool)
    assert float(_squared_error(0.3 + noise, found)) == pytest.approx(0.09, abs=0.02)
    one_for_both = (0.3 + noise[0]).expand(2, -1, -1)
    assert float(_squared_error(one_for_both, found)) > 1


@pytest.mark.parametrize("fit_networks", [False, True])
def test_a_fit_begins_at_the_prior_which_stays_as_it_is(tmp_path, fit_networks):
    folder = write_object(tmp_path / "ball")
    settings = NeumatexModelConfig(
        material="pbr", prior="small", fit_networks=fit_networks, samples=2, plane_resolution=32
    )
    pixels = ObjectDataManagerConfig(train_num_rays_per_batch=64)
    pipeline = PipelineConfig(datamanager=pixels, model=settings).setup(
        data=folder, device=torch.device("cpu")
    )
    pipeline.initialise()
    groups = pipeline.model.get_param_groups()
    assert bool(groups["networks"]) is fit_networks
    pipeline.train()
    pipeline.seed_step(0)
    _, losses, _ = pipeline.get_train_loss_dict(0)
    assert float(losses["prior"].detach()) == 0
    with torch.no_grad():
        pipeline.model.triplane.planes += 0.1
    _, losses, _ = pipeline.get_train_loss_dict(0)
    assert float(losses["prior"].detach()) > 0
    torch.stack(list(losses.values())).sum().backward()
    moved = {name for name, parameter in pipeline.model.named_parameters() if parameter.grad is not None}
    assert "triplane.planes" in moved
    assert (len(moved) > 1) is fit_networks
    assert all(name.startswith("triplane.") for name in moved)


@pytest.fixture(scope="module")
def neural(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps with neural materials."""
    return trained_on(write_object(tmp_path_factory.mktemp("object") / "ball"), steps=2)


def test_the_material_is_exported_with_its_latents_and_decoder(neural, tmp_path):
    words = ["material", "--run", neural, "--output", tmp_path, "--device", "cpu", "--texture-size", 64]
    done(export, *words)
    scene = load_run(neural, "cpu").scene
    assert isinstance(scene, TrainedObject)
    expected = set(material_paths(tmp_path, scene.surface.family))
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == expected
    assert {"decoder.glsl", "latents_a.png", "latents_b.exr"} <= {path.name for path in expected}
    assert "--overwrite" in refused(export, *words)
    assert "choose 16 to 8192" in refused(export, *words, "--overwrite", "--texture-size", 3)


def test_products_of_mixed_materials_are_refused_in_one_sentence(neural, tmp_path):
    said = refused(export, "endmembers", "--run", neural, "--output", tmp_path, "--device", "cpu")
    assert "the method neumatex makes no scene of mixed materials" in said
    assert "unmix-export has products of its own for it: material" in said


def test_a_view_is_rendered_under_a_map_from_a_file(neural, tmp_path):
    light = write_light(tmp_path / "light", sky=3.0)
    words = ["--run", neural, "--device", "cpu", "--view", 0, "--outputs", "linear_rgb", "--formats", "npy"]
    pictures = []
    for name, rest in (("own", []), ("brighter", ["--environment", light])):
        done(render, *words, "--output", tmp_path / name, *rest)
        pictures.append(np.load(next((tmp_path / name / "linear_rgb").glob("*.npy"))))
    assert pictures[0].max() > 0.01
    np.testing.assert_allclose(pictures[1], 3 * pictures[0], rtol=1e-3, atol=1e-5)
    said = refused(render, *words, "--output", tmp_path / "none", "--environment", tmp_path / "none.hdr")
    assert "there is no such environment map" in said


def test_training_that_goes_on_does_not_change_a_scene(neural):
    loaded = load_model(neural, "cpu")
    scene = snapshot(loaded.model, "neumatex", loaded.scene)
    assert isinstance(scene, TrainedObject)
    camera = scene.views[0].camera
    before = scene.render(camera, ["base_colour", "latents_a", "uncertainty"])
    with torch.no_grad():
        for param in loaded.model.parameters():
            param.add_(0.5)
    after = scene.render(camera, ["base_colour", "latents_a", "uncertainty"])
    for name, values in before.items():
        torch.testing.assert_close(after[name], values, rtol=0, atol=0)
    changed = snapshot(loaded.model, "neumatex", loaded.scene).render(camera, ["base_colour"])
    assert not torch.equal(changed["base_colour"], before["base_colour"])
