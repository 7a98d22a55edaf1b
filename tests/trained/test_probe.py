from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.factories.ball_model import RADIUS, SHADE, BallField, ball_scene, cameras_around
from tests.factories.cameras import FRAME, around
from tests.factories.models import make_scene
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.trained_scene import one_pixel

SCENE = make_scene()
BALL = replace(ball_scene(), frame=FRAME)
CAMERA = replace(around()[2], distortion=torch.tensor([[0.05, -0.02, 0.001, 0.002]]))


@pytest.mark.parametrize("pixel", [(0, 0), (39, 29), (20, 15), (17, 9)])
def test_a_pixel_is_that_of_the_whole_render(pixel):
    column, row = pixel
    view = SCENE.look(CAMERA)
    whole = view.coefficients
    probe = SCENE.probe(CAMERA, *pixel)
    for name, key in (("predicted", "spectral"), ("diffuse", "diffuse"), ("specular", "specular")):
        expected = view[key][row, column]
        np.testing.assert_allclose(probe.spectra[name], expected, atol=1e-6)
    np.testing.assert_allclose(probe.opacity, whole.accumulation[row, column], atol=1e-6)
    shares = whole.abundances[row, column] / whole.accumulation[row, column].clamp(min=1e-6)
    np.testing.assert_allclose(probe.abundances, shares, atol=1e-4)


def test_a_pixel_tells_where_its_surface_is_in_the_world():
    [camera] = cameras_around([(1.0, 0.0, 1.0)])
    middle = (camera.width // 2, camera.height // 2)
    probe = BALL.probe(camera, *middle)
    assert probe.world_position is not None
    place = FRAME.to_model(probe.world_position)
    np.testing.assert_allclose(place, RADIUS * np.array([1, 0, 1]) / np.sqrt(2), atol=0.03)
    np.testing.assert_allclose(probe.abundances, [1, 0, 0], atol=1e-4)
    corner = BALL.probe(camera, *(0, 0))
    assert (corner.opacity, corner.world_position) == (0.0, None)
    assert corner.abundances.max() == 0


class LampOnCamera(BallField):
    """The ball in a light that stands at the camera: as bright as it is lit squarely."""

    def get_outputs(self, positions, directions, features, light=None):
        found = super().get_outputs(positions, directions, features, light)
        outwards = torch.nn.functional.normalize(positions, dim=-1)
        squareness = -(outwards * directions).sum(dim=-1, keepdim=True)
        return {**found, "scaled_abundances": squareness.clamp(min=0) * found["scaled_abundances"]}


@pytest.mark.parametrize("field", [BALL.field, LampOnCamera()])
@pytest.mark.parametrize("away", [(1.0, 0.0, 0.2), (0.3, -0.5, -0.8)])
def test_a_point_is_what_the_field_says_there_lit_squarely(field, away):
    world = FRAME.to_world(RADIUS * np.array(away) / np.linalg.norm(away))
    probe = replace(BALL, field=field).probe_point(*world.tolist())
    material = 0 if away[2] > 0 else 1
    assert list(probe.spectra) == ["predicted"]
    np.testing.assert_allclose(probe.abundances, np.eye(3)[material], atol=1e-6)
    expected = SHADE * BALL.materials.endmembers[material]
    np.testing.assert_allclose(probe.spectra["predicted"], expected, atol=1e-4)
    np.testing.assert_array_equal(probe.world_position, world)


def test_inside_a_point_is_opaque_and_empty_space_is_not():
    assert BALL.probe_point(*FRAME.to_world(np.array([0.3, 0.1, -0.3])).tolist()).opacity > 0.99
    world = FRAME.to_world(np.array([0.9, 0.9, 0.9])).tolist()
    assert BALL.probe_point(*world).opacity < 1e-6
    empty = replace(SCENE.renderer, skips=torch.ones(8, 8, 8, dtype=torch.uint8))
    nothing = replace(SCENE, renderer=empty, frame=FRAME).probe_point(*world)
    assert (nothing.opacity, nothing.abundances.max(), nothing.spectra["predicted"].max()) == (0, 0, 0)


def test_what_is_outside_the_image_or_the_box_is_refused_with_its_bounds():
    for pixel in ((-1, 0), (40, 0), (0, 30)):
        with pytest.raises(ConfigError, match="columns are 0 to 39, rows 0 to 29"):
            one_pixel(CAMERA, *pixel)
    said = r"the point 99,0,0 is .* between -2,-3.7,-9 and 6,4.3,-1 of the world"
    with pytest.raises(ConfigError, match=said):
        BALL.probe_point(99.0, 0.0, 0.0)
