"""The method from the command line on a ball, in colours and of two materials: train, resume, evaluate, export, render
under other light; where fits begin, and gains of endmembers."""

import json
import shutil
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
import torch
from torch.testing import assert_close

from tests.factories import ball_model, objects
from tests.factories.commands import done, picture_size, refused, run
from tests.factories.objects import SMALL, trained_on, write_light, write_object, write_spectral_object
from tests.factories.surfaces import generator, unit
from tests.factories.systems import needs_xatlas
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.engine import PipelineConfig, load_model
from unmix_plugin.engine.machine import operations_shared_among
from unmix_plugin.neumatex.export import pbr_fit
from unmix_plugin.neumatex.export.material import material_paths
from unmix_plugin.neumatex.fit import start
from unmix_plugin.neumatex.fit.data_manager import ObjectDataManagerConfig
from unmix_plugin.neumatex.fit.model import NeumatexModel, unbiased_squared_error
from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig
from unmix_plugin.neumatex.fit.start import as_bright_as_seen
from unmix_plugin.neumatex.fit.trained_object import TrainedObject
from unmix_plugin.neumatex.tracing.families import SpectralFamily
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.colour.conversion import agx
from unmix_plugin.spectral.library.spectra_csv import read_spectra
from unmix_plugin.trained.model_scene import LightChoice
from unmix_plugin.trained.open_run import load_run, snapshot
from unmix_plugin.viewer.rendering.painting import layers_of, paint_layer
from unmix_plugin.viewer.rendering.settings import LayerSettings

PBR, NO_PRIOR = "--pipeline.model.material=pbr", "--pipeline.model.prior=none"
SPECTRAL = ["--pipeline.model.material=spectral", "--pipeline.model.num-endmembers=2"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of 30 steps."""
    return trained_on(write_object(tmp_path_factory.mktemp("neumatex") / "ball"), PBR, steps=30)


@pytest.fixture(scope="module")
def neural(tmp_path_factory):
    """A run of two steps with neural materials."""
    return trained_on(write_object(tmp_path_factory.mktemp("object") / "ball"), NO_PRIOR, steps=2)


@pytest.fixture(scope="module")
def spectral(tmp_path_factory):
    """A run of 30 steps."""
    folder = write_spectral_object(tmp_path_factory.mktemp("neumatex") / "ball")
    return trained_on(folder, *SPECTRAL, steps=30)


@pytest.fixture(scope="module")
def scene(spectral) -> TrainedObject:
    found = load_run(spectral, "cpu").scene
    assert isinstance(found, TrainedObject)
    return found


def test_evaluation_finds_colour_and_light_again_also_under_a_light_never_seen(trained):
    done(evaluate, "--run", trained, "--device", "cpu")
    figures = json.loads((trained / "eval" / "metrics.json").read_text())
    assert {"psnr", "relit_psnr", "base_colour_psnr", "views", "lights", "train_seconds"} <= set(figures)
    assert (figures["views"], figures["lights"]) == (1, 1)
    assert min(figures["psnr"], figures["relit_psnr"]) > 22
    # Even light can't tell a metal from what is diffuse, so only light has to be right.
    assert 8 < figures["base_colour_psnr"] <= figures["base_colour_psnr_scaled"]
    assert [image["name"] for image in figures["per_image"]] == ["000", "dim-000", "dim-001"]
    for picture in ("rgb/000.png", "relit_rgb/dim-001.png", "base_colour/000.png"):
        assert picture_size(trained / "eval" / picture) == (1058, 546)


@pytest.mark.parametrize("count", [1, 2])
def test_a_resumed_run_ends_where_a_straight_one_does(tmp_path, count):
    with operations_shared_among(count):
        straight = trained_on(write_object(tmp_path / "ball"), PBR, "--steps-per-save=3", steps=6)
        begun = shutil.copytree(straight, tmp_path / "begun")
        for path in begun.glob("checkpoints/step-000006*"):
            path.unlink()
        done(train, "neumatex", "--load-run", begun, "--max-num-iterations", 6)
    expected, found = (load_model(path, "cpu").model.state_dict() for path in (straight, begun))
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def test_a_run_does_not_go_on_with_other_poses(trained, tmp_path):
    moved = shutil.copytree(trained.parents[3] / "ball", tmp_path / "ball")
    content = json.loads((moved / "transforms.json").read_text())
    content["frames"][1]["transform_matrix"][0][3] += 0.01
    (moved / "transforms.json").write_text(json.dumps(content))
    said = refused(train, "neumatex", "--load-run", trained, "--data", moved, "--max-num-iterations", 31)
    assert "training cameras.camera_to_world differ" in said


def test_what_pictures_of_light_are_compared_through_does_not_change_how_light_is_shown(tmp_path):
    settings = NeumatexModelConfig(material="pbr", prior="none", light_curve="linear", plane_resolution=2)
    pipeline = PipelineConfig(datamanager=ObjectDataManagerConfig(), model=settings)
    model = pipeline.setup(data=write_object(tmp_path / "ball"), device=torch.device("cpu")).model
    light = torch.tensor([[0.2, 1.0, 4.0]])
    assert_close(model.curve(light), agx(light))


def test_bad_input_ends_with_status_2_and_one_message(tmp_path):
    for material, write, expected in (
        ("pbr", write_spectral_object, "does not fit pictures of 5 bands; choose spectral"),
        ("spectral", write_object, "does not fit pictures of 3 colours; choose neural or pbr"),
        ("pbr", write_object, "environment.exr"),
    ):
        folder = write(tmp_path / material / write.__name__)
        if expected == "environment.exr":
            (folder / "environment.exr").write_bytes(b"no picture")
        words = ["--data", folder, "--output-dir", tmp_path / "out", f"--pipeline.model.material={material}"]
        ended = run(train, "neumatex", *words, *SMALL)
        assert (ended.status, len(ended.err.strip().splitlines())) == (2, 1)
        assert expected in ended.err
        assert not (tmp_path / "out").exists()


def test_display_pictures_train_their_response(tmp_path):
    run = trained_on(write_object(tmp_path / "ball", suffix=".png"), PBR, NO_PRIOR, steps=3)
    model = load_model(run, "cpu").model
    assert float(model.get_parameter("curve.coefficients").detach().abs().max()) > 0


def test_the_loss_leaves_the_noise_of_the_render_out():
    noise = torch.randn(2, 40_000, 3, generator=generator())
    found = torch.ones(40_000, dtype=torch.bool)
    assert float(unbiased_squared_error(0.3 + noise, found)) == pytest.approx(0.09, abs=0.02)
    one_for_both = (0.3 + noise[0]).expand(2, -1, -1)
    assert float(unbiased_squared_error(one_for_both, found)) > 1


@pytest.mark.parametrize(("material", "fit_networks"), [("pbr", False), ("neural", True)])
def test_a_fit_begins_at_the_prior_which_stays_as_it_is(tmp_path, material, fit_networks):
    folder = write_object(tmp_path / "ball")
    settings = NeumatexModelConfig(material=material, prior="small", samples=2, plane_resolution=32)
    settings = replace(settings, fit_networks=fit_networks)
    config = PipelineConfig(datamanager=ObjectDataManagerConfig(train_num_rays_per_batch=64), model=settings)
    pipeline = config.setup(data=folder, device=torch.device("cpu"))
    pipeline.initialise()
    assert bool(pipeline.model.get_param_groups()["networks"]) is fit_networks
    pipeline.train()
    pipeline.seed_step(0)
    _, losses, _ = next(pipeline.train_batches(0))()
    assert float(losses["prior"].detach()) == 0
    with torch.no_grad():
        pipeline.model.triplane.planes += 0.1
    _, losses, _ = next(pipeline.train_batches(0))()
    assert float(losses["prior"].detach()) > 0
    torch.stack(list(losses.values())).sum().backward()
    moved = {name for name, parameter in pipeline.model.named_parameters() if parameter.grad is not None}
    assert "triplane.planes" in moved
    assert (len(moved) > 1) is fit_networks
    assert all(name.startswith("triplane.") for name in moved)


@needs_xatlas
def test_the_material_is_exported_with_its_decoder_and_mixtures_are_not(neural, tmp_path, monkeypatch):
    monkeypatch.setattr(pbr_fit, "_STEPS", 5)
    place = ["--run", neural, "--output", tmp_path, "--device", "cpu"]
    said = refused(export, "endmembers", *place)
    assert "the method neumatex makes no scene of mixed materials" in said
    assert "unmix-export has products of its own for it: material" in said
    words = ["material", *place, "--texture-size", 64]
    done(export, *words)
    scene = load_run(neural, "cpu").scene
    assert isinstance(scene, TrainedObject)
    expected = set(material_paths(tmp_path, scene.surface.family))
    assert {path for path in tmp_path.rglob("[!.]*") if path.is_file()} == expected
    assert {"decoder.glsl", "latents_a.png", "latents_b.exr"} <= {path.name for path in expected}
    assert "--overwrite" in refused(export, *words)
    assert "choose 16 to 8192" in refused(export, *words, "--overwrite", "--texture-size", 3)


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


def test_evaluation_finds_reflectances_and_shares_again_and_the_light_of_another_environment(spectral):
    done(evaluate, "--run", spectral, "--device", "cpu")
    figures = json.loads((spectral / "eval" / "metrics.json").read_text())
    assert (figures["views"], figures["lights"]) == (1, 1)
    for name, least in {"psnr": 22, "relit_psnr": 25, "base_colour_psnr": 20}.items():
        assert figures[name] > least
    for name, most in {"endmember_angle": 0.15, "abundance_rmse": 0.2, "sam": 0.15}.items():
        assert figures[name] < most
    width, height = picture_size(spectral / "eval" / "base_colour" / "000.png")
    assert width > 2 * height - 100 > 900  # two pictures of 512 pixels, enlarged and titled


def test_every_output_is_shown_from_the_run_folder_alone(scene):
    view = scene.look(scene.views[0].camera)
    channels = {"spectral": 5, "reflectance": 5, "abundances": 2}
    for output in scene.outputs:
        expected = () if output.kind in ("map", "labels") else (channels.get(output.name, 3),)
        assert view[output.name].shape == (24, 24, *expected), output.name
    middle, corner = (12, 12), (0, 0)
    assert float(view["abundances"][middle].sum()) == pytest.approx(1, abs=1e-5)
    assert set(view["segmentation"][[6, 18], [12, 12]].tolist()) == {0, 1}
    assert view["segmentation"][corner] == 255
    assert view["spectral"][corner].abs().max() == 0


def test_the_viewer_paints_abundances_as_a_mixture_of_the_colours_of_the_segmentation(scene):
    view, layers = scene.look(scene.views[0].camera), layers_of(scene)
    both = [paint_layer(layers[name], view, LayerSettings(), None) for name in ("abundances", "segmentation")]
    (mixed, labelled), legend = (one.over()[:, :, 0].float() for one in both), both[0].legend
    assert isinstance(legend, tuple)
    assert [name for name, _ in legend] == ["abundances 0", "abundances 1"]
    colours = torch.tensor([colour for _, colour in legend])
    for row, column in ((6, 12), (18, 12)):
        shares = view["abundances"][row, column]
        torch.testing.assert_close(mixed[row, column], shares @ colours, atol=1e-4, rtol=0)
        torch.testing.assert_close(labelled[row, column], colours[shares.argmax()], atol=1e-4, rtol=0)


def test_another_light_in_colours_gets_the_lamps_spectrum(scene):
    relit = scene.with_light(LightChoice("overcast", 0.0, 0.0))
    spectrum = relit.environment.image[3, 5].double().numpy()
    np.testing.assert_allclose(spectrum / spectrum.max(), objects.LAMP, rtol=1e-5)
    back = relit.with_light(LightChoice(None, 0.0, 0.0))
    assert torch.equal(back.environment.image, scene.environment.image)


@needs_xatlas
def test_the_export_has_abundance_textures_and_endmembers(spectral):
    done(export, "material", "--run", spectral, "--device", "cpu", "--texture-size", 64)
    folder = spectral / "exports" / "material"
    table = read_spectra(folder / "endmembers.csv")
    assert all(name.endswith((" 1", " 2")) for name in table.names)
    found = table.spectra / np.linalg.norm(table.spectra, axis=1, keepdims=True)
    true = objects.ENDMEMBERS / np.linalg.norm(objects.ENDMEMBERS, axis=1, keepdims=True)
    assert np.sort((found @ true.T).max(axis=1)).min() > 0.98
    channels = OpenEXR.File(str(folder / "abundances.exr"), separate_channels=True).channels()
    total = np.sum([channel.pixels for channel in channels.values()], axis=0)
    assert total.shape == (64, 64)
    np.testing.assert_allclose(total[total > 0], 1, atol=1e-5)
    assert (folder / "material.glb").stat().st_size > 1000


def test_the_number_of_materials_is_proposed_where_it_is_asked_for(tmp_path):
    folder = write_spectral_object(tmp_path / "ball")
    run = trained_on(folder, *SPECTRAL, "--pipeline.model.num-endmembers=auto", steps=1)
    assert len(load_model(run, "cpu").model.get_parameter("endmembers")) == 2


def test_a_fit_starts_from_the_endmembers_and_abundances_of_a_run(tmp_path, monkeypatch):
    there = Normalisation(np.eye(3), -objects.CENTRE, ball_model.RADIUS / objects.RADIUS)
    of_run = replace(ball_model.ball_scene(), frame=there)
    monkeypatch.setattr(start, "opened_run", lambda _: of_run)
    folder = write_spectral_object(tmp_path / "ball")
    settings = [SPECTRAL[0], "--pipeline.model.from-run=run", "--pipeline.datamanager.lamp=E"]
    model = load_model(trained_on(folder, *settings, steps=1), "cpu").model
    assert isinstance(model, NeumatexModel)
    assert model.endmembers is not None
    light = torch.ones(5) if of_run.light is None else of_run.light
    expected = unit(of_run.materials.endmembers.detach() / light)
    found = unit(model.endmembers.detach())
    assert float((found * expected).sum(dim=1).min()) > 0.999
    poles = torch.tensor([[0.0, 0.1, 0.99], [0.1, 0.0, -0.99]])
    assert model.surface.parameters(poles)[:, :3].argmax(dim=1).tolist() == [0, 1]


DARK_AND_BRIGHT = torch.tensor([[0.05, 0.1, 0.2, 0.1], [0.9, 0.8, 0.4, 0.2]])


def test_mixed_pixels_do_not_make_dark_endmembers_brighter_nor_bright_ones_darker():
    share = torch.rand(5000, 1, generator=generator())
    share[:200], share[200:400] = 0.0, 1.0  # few show one material alone
    pixels = torch.cat([share, 1 - share], dim=1) @ DARK_AND_BRIGHT
    purity = unit(pixels) @ unit(DARK_AND_BRIGHT).T
    assert_close(as_bright_as_seen(unit(DARK_AND_BRIGHT), pixels, purity), DARK_AND_BRIGHT, rtol=1e-3, atol=0)
    found = as_bright_as_seen(DARK_AND_BRIGHT, 5 * DARK_AND_BRIGHT, torch.eye(2))
    assert float(found.max()) <= 1
    assert_close(unit(found), unit(DARK_AND_BRIGHT))


MIXTURE = torch.tensor([[0.4, 0.6, 0.5, 0.2]])


@pytest.mark.parametrize("gains", [(0.5, 1.05), (3.0, 2.0)])
def test_gains_that_are_settled_leave_what_is_reflected_or_at_most_1_and_spectral_angles(gains):
    endmembers, factors = DARK_AND_BRIGHT.clone(), torch.tensor(gains)
    family = SpectralFamily(endmembers, factors)
    before = family.base_colour(MIXTURE)
    assert_close(before, (MIXTURE[:, :2] * factors) @ DARK_AND_BRIGHT)
    family.settle_gains()
    assert_close(unit(endmembers), unit(DARK_AND_BRIGHT))
    assert (float(endmembers.max()) <= 1, factors.tolist()) == (True, [1.0, 1.0])
    if max(gains) < 1.1:
        assert_close(family.base_colour(MIXTURE), before)


def test_the_gradient_of_a_gain_is_that_of_all_bands_of_its_endmember_together():
    endmembers, gains = DARK_AND_BRIGHT.clone().requires_grad_(), torch.ones(2, requires_grad=True)
    light = SpectralFamily(endmembers, gains).base_colour(MIXTURE).square().sum()
    of_endmembers, of_gains = torch.autograd.grad(light, (endmembers, gains))
    assert_close(of_gains, (of_endmembers * endmembers).sum(dim=1))


def test_training_that_goes_on_does_not_change_a_scene(neural):
    loaded = load_model(neural, "cpu")
    scene = snapshot(loaded.model, "neumatex", loaded.record)
    assert isinstance(scene, TrainedObject)
    camera, names = scene.views[0].camera, ["base_colour", "latents_a", "uncertainty"]
    before = scene.render(camera, names)
    with torch.no_grad():
        for param in loaded.model.parameters():
            param.add_(0.5)
    assert_close(scene.render(camera, names), before, rtol=0, atol=0)
    changed = snapshot(loaded.model, "neumatex", loaded.record).render(camera, ["base_colour"])
    assert not torch.equal(changed["base_colour"], before["base_colour"])
