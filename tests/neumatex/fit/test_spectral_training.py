"""Spectral materials from the command line on a ball of two, and gains of endmembers."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
from torch.testing import assert_close

from tests.commands.running import done, picture_size, refused
from tests.neumatex.factory import (
    CENTRE,
    ENDMEMBERS,
    LAMP,
    RADIUS,
    SMALL,
    trained_on,
    write_object,
    write_spectral_object,
)
from tests.neumatex.surfaces import unit
from tests.products.ball_model import RADIUS as RUN_RADIUS
from tests.products.ball_model import ball_scene
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.train import train
from unmix_plugin.engine import load_model
from unmix_plugin.neumatex.fit import data_manager, start
from unmix_plugin.neumatex.fit.model import NeumatexModel
from unmix_plugin.neumatex.fit.start import _as_bright
from unmix_plugin.neumatex.fit.trained_object import TrainedObject
from unmix_plugin.neumatex.tracing.families import SpectralFamily
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv
from unmix_plugin.trained.model_scene import LightChoice
from unmix_plugin.trained.open_run import load_run
from unmix_plugin.viewer.rendering.painting import layers_of
from unmix_plugin.viewer.rendering.settings import LayerSettings

SPECTRAL = ["--pipeline.model.material=spectral", "--pipeline.model.num-endmembers=2"]


@pytest.fixture(scope="module", autouse=True)
def few_pixels():
    """A ball of two materials needs few pixels to start from."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(data_manager, "_NUM_PIXELS", 2000)
        patch.setattr(start, "_POINTS", 512)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 30 steps."""
    folder = write_spectral_object(tmp_path_factory.mktemp("neumatex") / "ball")
    return trained_on(folder, *SPECTRAL, steps=30)


@pytest.fixture(scope="module")
def scene(trained) -> TrainedObject:
    found = load_run(trained, "cpu").scene
    assert isinstance(found, TrainedObject)
    return found


def test_evaluation_finds_reflectances_and_shares_again_and_the_light_of_another_environment(trained):
    done(evaluate, "--run", trained, "--device", "cpu")
    figures = json.loads((trained / "eval" / "metrics.json").read_text())
    assert (figures["views"], figures["lights"]) == (1, 1)
    assert figures["psnr"] > 22
    assert figures["relit_psnr"] > 25
    assert figures["base_colour_psnr"] > 20
    assert figures["endmember_angle"] < 0.15
    assert figures["abundance_rmse"] < 0.2
    assert figures["sam"] < 0.15
    width, height = picture_size(trained / "eval" / "base_colour" / "000.png")
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
    mixed, legend = layers["abundances"].paint(view, LayerSettings(), None)  # type: ignore[arg-type]
    labelled, _ = layers["segmentation"].paint(view, LayerSettings(), None)  # type: ignore[arg-type]
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
    np.testing.assert_allclose(spectrum / spectrum.max(), LAMP, rtol=1e-5)
    back = relit.with_light(LightChoice(None, 0.0, 0.0))
    assert torch.equal(back.environment.image, scene.environment.image)


def test_the_export_has_abundance_textures_and_endmembers(trained):
    done(export, "material", "--run", trained, "--device", "cpu", "--texture-size", 64)
    folder = trained / "exports" / "material"
    table = read_spectra_csv(folder / "endmembers.csv")
    assert table.names == ("endmember_0", "endmember_1")
    found = table.spectra / np.linalg.norm(table.spectra, axis=1, keepdims=True)
    true = ENDMEMBERS / np.linalg.norm(ENDMEMBERS, axis=1, keepdims=True)
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
    there = Normalisation(np.eye(3), -CENTRE, RUN_RADIUS / RADIUS)
    of_run = replace(ball_scene(), frame=there)
    monkeypatch.setattr(start, "_opened", lambda _: of_run)
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


@pytest.mark.parametrize(
    ("material", "is_spectral", "expected"),
    [
        ("pbr", True, "does not fit pictures of 5 bands; choose spectral"),
        ("spectral", False, "does not fit pictures of 3 colours; choose neural or pbr"),
    ],
)
def test_a_material_that_does_not_fit_the_pictures_ends_with_status_2(
    tmp_path, material, is_spectral, expected
):
    write = write_spectral_object if is_spectral else write_object
    folder = write(tmp_path / "ball")
    words = ["--data", folder, "--output-dir", tmp_path / "out", f"--pipeline.model.material={material}"]
    assert expected in refused(train, "neumatex", *words, *SMALL)


DARK_AND_BRIGHT = torch.tensor([[0.05, 0.1, 0.2, 0.1], [0.9, 0.8, 0.4, 0.2]])


def test_mixed_pixels_do_not_make_dark_endmembers_brighter_nor_bright_ones_darker():
    generator = torch.Generator().manual_seed(0)
    share = torch.rand(5000, 1, generator=generator)
    share[:200], share[200:400] = 0.0, 1.0  # few show one material alone
    pixels = torch.cat([share, 1 - share], dim=1) @ DARK_AND_BRIGHT
    purity = unit(pixels) @ unit(DARK_AND_BRIGHT).T
    assert_close(_as_bright(unit(DARK_AND_BRIGHT), pixels, purity), DARK_AND_BRIGHT, rtol=1e-3, atol=0)
    found = _as_bright(DARK_AND_BRIGHT, 5 * DARK_AND_BRIGHT, torch.eye(2))
    assert float(found.max()) <= 1
    assert_close(unit(found), unit(DARK_AND_BRIGHT))


@pytest.mark.parametrize("gains", [(0.5, 1.05), (3.0, 2.0)])
def test_gains_that_are_settled_leave_what_is_reflected_or_at_most_1_and_spectral_angles(gains):
    endmembers, factors = DARK_AND_BRIGHT.clone(), torch.tensor(gains)
    family, parameters = SpectralFamily(endmembers, factors), torch.tensor([[0.4, 0.6, 0.5, 0.2]])
    before = family.base_colour(parameters)
    assert_close(before, (torch.tensor([[0.4, 0.6]]) * factors) @ DARK_AND_BRIGHT)
    family.settle_gains()
    assert_close(unit(endmembers), unit(DARK_AND_BRIGHT))
    assert float(endmembers.max()) <= 1
    assert factors.tolist() == [1.0, 1.0]
    if max(gains) < 1.1:
        assert_close(family.base_colour(parameters), before)


def test_the_gradient_of_a_gain_is_that_of_all_bands_of_its_endmember_together():
    endmembers, gains = DARK_AND_BRIGHT.clone().requires_grad_(), torch.ones(2, requires_grad=True)
    light = SpectralFamily(endmembers, gains).base_colour(torch.tensor([[0.4, 0.6, 0.5, 0.2]])).square().sum()
    of_endmembers, of_gains = torch.autograd.grad(light, (endmembers, gains))
    assert_close(of_gains, (of_endmembers * endmembers).sum(dim=1))
