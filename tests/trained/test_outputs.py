import inspect
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.ball_model import RADIUS, ball_scene, cameras_around
from tests.factories.cameras import BOX, FRAME, around, record
from tests.factories.models import CAMERA, NUM_BANDS, make_scene
from tests.factories.rgb_nerf import RgbNerf, RgbNerfConfig
from unmix_plugin.engine.outputs import Output
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.products.render.job import needs_survey, take_survey
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.features import continuum_removed, derivative_matrix
from unmix_plugin.trained.mixture_view import usual_range
from unmix_plugin.trained.model_scene import model_scene
from unmix_plugin.trained.plain_outputs import OUTPUTS
from unmix_plugin.trained.protocol import RenderableScene, RenderedView
from unmix_plugin.trained.trained_scene import MaterialView
from unmix_plugin.trained.unexplained_map import UnexplainedMap

EVERYWHERE = UnexplainedMap(np.full(3, -4.0), 8.0, np.zeros((1, 3), np.int64), np.full(1, 0.25, np.float32))
SCENE = replace(make_scene(light=[0.5, 0.7, 1.0, 0.9, 0.6]), unexplained=EVERYWHERE)
WITH_ARGUMENTS = (
    *("band:500nm", "false-colour:650,550,450", "index:r600/r500"),
    *("absorption:450-650", "absorption:area:450-650", "library:+builtin", "library:angle:+builtin"),
)
CHANNELS = {
    **dict.fromkeys(("channels", "spectra"), (NUM_BANDS,)),
    **dict.fromkeys(("shares", "srgb", "linear", "picture", "vectors"), (3,)),
    **dict.fromkeys(("grey", "map", "labels"), ()),
}


@pytest.fixture(scope="module")
def view() -> MaterialView:
    return SCENE.look(CAMERA)


@pytest.mark.parametrize("name", [*OUTPUTS, *WITH_ARGUMENTS])
def test_an_output_has_the_shape_and_the_values_that_it_promises(view, name):
    output, values = SCENE.output(name), view[name]
    assert output.name == name
    assert values.shape == (CAMERA.height, CAMERA.width, *CHANNELS[output.kind])
    assert (values.dtype == torch.uint8) == (output.kind == "labels")
    assert not values.requires_grad
    assert not values.isinf().any()
    undefined = ("index:", "absorption:", "library:", "unexplained")
    may_be_undefined = output.kind == "spectra" or name.startswith(undefined)
    assert may_be_undefined or not values.isnan().any()
    low, high = output.value_range or (-torch.inf, torch.inf)
    known = values[~values.isnan()] if values.is_floating_point() else values
    assert known.min() >= low - 1e-6
    assert known.max() <= high + 1e-6
    if output.kind in ("map", "shares") and output.value_range is None:  # it gets one from the views
        assert needs_survey([output])
        assert name in take_survey(SCENE, SCENE.views, [output]).ranges


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_the_range_of_colours_follows_the_unit_of_lengths(unit):
    low, high = usual_range(
        torch.cat([unit * torch.linspace(1, 2, 101), torch.tensor([torch.nan, torch.inf])])
    )
    assert (low / unit, high / unit) == pytest.approx((1.01, 1.99))
    same = usual_range(torch.full((5,), unit))
    assert same[1] > same[0]
    assert usual_range(torch.ones(3), low_at_most=0.0) == (0.0, 1.0)
    assert usual_range(torch.full((3,), torch.nan)) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("abundence", "no output named 'abundence' .did you mean abundance"),
        ("abundance", "the output abundance needs a name or a number from 0, as in abundance:0"),
        ("abundance:9", "abundance:9: there is no endmember '9'; known are .* 1, "),
        ("bands:650", r"no output named 'bands:650' \(did you mean band "),
        ("band", "the output band needs a wavelength, as in band:650nm"),
        ("index:", "the output index needs to know which, as in index:ndvi"),
        ("band:red", "'red' in the output band:red is not a wavelength in nm, such as 650nm"),
        ("false-colour:650,550", "takes three wavelengths, as in false-colour:860,650,550"),
        ("false-colour:650,550,blue", "'blue' in the output false-colour:650,550,blue is not a wavelength"),
        ("index:nvdi", "no index 'nvdi'; nearest: .*ndvi"),
        ("target:", "the output target needs to know which, as in target:paint.csv"),
        ("rgb:1", "no output named 'rgb:1'"),
    ],
)
def test_a_name_that_means_nothing_is_refused_with_what_could_be_meant(name, message):
    with pytest.raises(ConfigError, match=message):
        SCENE.output(name)


def test_colours_of_bands_that_no_eye_sees_are_said_to_be_false():
    scene = make_scene()
    infrared = replace(scene.materials, bands=Bands.of(scene.bands.centers_nm + 500))
    for name in ("rgb", "linear_rgb"):
        assert "false colour" not in scene.output(name).what
        assert "0 to 1; false colour: red " in replace(scene, materials=infrared).output(name).what


def test_bands_are_told_by_the_wavelength_that_is_shown_and_refused_before_anything_is_rendered(monkeypatch):
    band, exact = SCENE.output("band:530nm"), SCENE.output("band:550nm")
    assert band.what.endswith(": 550 nm (asked: 530 nm)")
    assert exact.what.endswith(": 550 nm")
    composite = SCENE.output("false-colour:640, 550,460nm")
    assert composite.what.endswith(": 650, 550, 450 nm (asked: 640, 550, 460 nm)")
    assert (band.centers_nm, composite.centers_nm) == ((550.0,), (650.0, 550.0, 450.0))
    assert SCENE.output("spectral").centers_nm == ()
    monkeypatch.setattr(type(SCENE), "look", None)
    for name in ("band:900nm", "false-colour:860,650,550", "index:ndvi"):
        with pytest.raises(SpectrumError, match="nm"):
            SCENE.render(CAMERA, [name])


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("continuum", continuum_removed),
        ("derivative", lambda values, w: values @ torch.from_numpy(derivative_matrix(w)).float()),
        ("second_derivative", lambda values, w: values @ torch.from_numpy(derivative_matrix(w, 2)).float()),
    ],
)
@pytest.mark.parametrize("dark", [0.0, 1e-5])
def test_features_are_those_of_the_bands_with_light_and_undefined_in_the_dark_ones(name, function, dark):
    w = np.linspace(450.0, 700.0, 7)
    materials = replace(
        SCENE.materials,
        bands=Bands.of(w),
        endmembers=torch.rand(3, 7, generator=torch.Generator().manual_seed(0)),
        specular_spectra=torch.zeros(len(SCENE.materials.specular_spectra), 7),
        light=torch.tensor([0.5, 0.7, 1.0, 0.9, 0.6, 0.5, dark]),
    )
    scene = replace(SCENE, materials=materials)
    view = scene.look(CAMERA)
    seen = view.opacity >= 0.5
    assert view[name][..., 6].isnan().all()
    expected = function(view["reflectance"][seen][:, :6], w[:6]).float()
    assert expected.isfinite().all()
    assert_close(view[name][seen][:, :6], expected)
    light = torch.tensor([1.0, 1, 1, 1, dark, dark, dark])
    few = replace(scene, materials=replace(materials, light=light))
    if "derivative" in name:
        with pytest.raises(SpectrumError, match="a derivative takes 5 bands or more; found 4"):
            few.output(name)


def test_depth_distance_and_normals_are_those_of_the_world():
    [camera] = cameras_around([(1.0, 2.0, 0.5)], side_px=41)
    scene = replace(ball_scene(), frame=FRAME)
    seen = scene.look(camera)
    assert seen["ray_distance"][20, 20].item() == pytest.approx((3 - RADIUS) / FRAME.scale, abs=0.05)
    assert_close(seen["depth"][20, 20], seen["ray_distance"][20, 20], rtol=1e-3, atol=0)
    off_axis = float(seen["ray_distance"][20, 28] / seen["depth"][20, 28])
    assert off_axis == pytest.approx(np.hypot(8 / 65.6, 1.0), rel=1e-3)  # 8 pixels of 65.6 of focal length
    towards_camera = torch.tensor(np.array([1.0, 2.0, 0.5]) / np.sqrt(5.25) @ FRAME.rotation)
    assert_close(seen["normals"][20, 20].double(), towards_camera, rtol=0, atol=0.05)
    corner = [seen[name][0, 0] for name in ("depth", "ray_distance", "normals")]
    assert all((values == 0).all() for values in corner)


class Described(RgbNerf):
    """A method without endmembers."""

    outputs = (Output("rgb", "srgb", "colour", "sRGB on black, 0 to 1"),)


def described() -> Described:
    return Described(RgbNerfConfig(), scene_box=BOX, metadata={"grid_size": 6})


RECORD = record(around(2), around(1))


@pytest.mark.parametrize("scene", [SCENE, model_scene(described(), RECORD)], ids=["materials", "model"])
def test_scenes_of_both_kinds_keep_the_protocol(scene):
    assert isinstance(scene, RenderableScene)
    assert isinstance(scene.look(CAMERA), RenderedView)
    for name in ("output", "look", "render", "probe"):
        promised, kept = (inspect.signature(getattr(kind, name)) for kind in (RenderableScene, type(scene)))
        assert list(kept.parameters) == list(promised.parameters), name
    name = scene.outputs[0].name
    assert torch.equal(scene.render(CAMERA, [name])[name], scene.look(CAMERA)[name])
    with pytest.raises(ConfigError, match="no output named 'smell'"):
        scene.render(CAMERA, ["smell"])
    with pytest.raises(ConfigError, match="outside the image"):
        scene.probe(CAMERA, CAMERA.width, 0)


def test_the_scene_of_a_model_stays_as_it_was_while_training_goes_on_and_needs_outputs():
    model = described()
    scene = model_scene(model, RECORD)
    before = scene.render(CAMERA, ["rgb"])["rgb"]
    with torch.no_grad():
        for param in model.parameters():
            param.add_(1.0)
    assert torch.equal(scene.render(CAMERA, ["rgb"])["rgb"], before)
    averages = {name: param.detach() - 1 for name, param in model.named_parameters()}
    averaged = model_scene(model, RECORD, averages)
    assert_close(averaged.render(CAMERA, ["rgb"])["rgb"], before)
    model.outputs = ()
    with pytest.raises(ConfigError, match="Described names no outputs"):
        model_scene(model, RECORD)
