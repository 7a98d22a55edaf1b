import numpy as np
import pytest
import torch

from tests.factories.ball_views import LAMP, ball_views
from tests.factories.files import present
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.light import search as lamp_search
from unmix_plugin.light.search import find_lamp
from unmix_plugin.scenes.demo.scene import demo_cameras
from unmix_plugin.scenes.demo.shading import LAMP_POSITION, render_view
from unmix_plugin.scenes.geometry.carving import carve_box
from unmix_plugin.scenes.geometry.lighting import local_log_brightness


@pytest.fixture
def believed(monkeypatch):
    """Every lamp is believed that explains enough of the changes, whatever its shadows do."""
    monkeypatch.setattr(lamp_search, "LEAST_SHADOWS", -1.0)
    monkeypatch.setattr(lamp_search, "LEAST_AGREEMENT", -1.0)


@pytest.mark.usefixtures("believed")
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_the_brightness_of_a_turned_ball_tells_the_direction_of_its_lamp(noise):
    lamp = present(find_lamp(*ball_views(True, noise)))
    place = np.array(lamp.place) / np.linalg.norm(lamp.place)
    assert np.degrees(np.arccos(place @ LAMP / np.linalg.norm(LAMP))) < 12
    np.testing.assert_allclose(lamp.middle, (0, 0, 0), atol=1e-4)
    np.testing.assert_allclose(lamp.axis, (0, 0, 1), atol=1e-4)  # to which the cameras stand upright


def test_a_lamp_that_explains_no_shadows_or_halves_of_the_places_disagree_about_is_not_believed(monkeypatch):
    views = ball_views(True)
    assert find_lamp(*views) is None
    monkeypatch.setattr(lamp_search, "LEAST_SHADOWS", -1.0)
    lamp = find_lamp(*views)
    assert lamp is not None
    assert np.dot(lamp.place, LAMP) / np.linalg.norm(lamp.place) / np.linalg.norm(LAMP) > 0.97
    monkeypatch.setattr(lamp_search, "LEAST_AGREEMENT", 1.01)
    assert find_lamp(*views) is None


@pytest.mark.usefixtures("believed")
def test_things_on_a_table_tell_in_which_frame_the_lamp_stands():
    cameras = demo_cameras(96, 24)
    shading, matter = [], []
    for index in range(24):
        x, y = cameras.camera_to_world[index, :2, 3].tolist()
        turn = np.array([[x, -y], [y, x]]) / np.hypot(x, y)
        lamp = (*(turn @ LAMP_POSITION[:2]).tolist(), LAMP_POSITION[2])
        view = render_view(cameras, index, subpixels=1, lamp=lamp)
        shading.append(local_log_brightness(torch.from_numpy(view.diffuse.sum(axis=-1)).float()))
        matter.append(view.alpha > 0)
    box = SceneBox(torch.tensor([[-1.4, -1.4, -0.15], [1.4, 1.4, 1.2]]))
    hull = carve_box(cameras, matter, box, 64)
    found = present(find_lamp(cameras, shading, hull, box))
    true = np.array([LAMP_POSITION[1], LAMP_POSITION[2] - found.middle[2], LAMP_POSITION[0]])
    cosine = np.dot(found.place, true) / np.linalg.norm(found.place) / np.linalg.norm(true)
    assert found.frame == "turntable"
    assert np.degrees(np.arccos(cosine)) < 20
