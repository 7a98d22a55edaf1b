"""The method from the command line on a ball of one colour: train, resume, evaluate; fits that begin at the prior."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from tests.commands.running import done, picture_size, run
from tests.neumatex.factory import SMALL, trained_on, write_object
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.train import train
from unmix_plugin.engine import PipelineConfig, load_model
from unmix_plugin.neumatex.fit.data_manager import ObjectDataManagerConfig
from unmix_plugin.neumatex.fit.model import _squared_error
from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig

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
