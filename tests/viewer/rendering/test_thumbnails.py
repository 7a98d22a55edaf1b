"""Images of a scene's cameras: what the views show, read once and in part."""

import numpy as np
import pytest
from PIL import Image

from tests.factories.scenes import make_scene
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.viewer.rendering.thumbnails import Thumbnails


@pytest.fixture
def folder(tmp_path):
    return make_scene(tmp_path / "scene")


def test_a_view_is_shown_in_its_own_colours_every_nth_pixel_of_it(folder):
    scene = load_scene(folder.root)
    step = scene.cameras[2].height // 4
    picture = np.asarray(Image.open(folder.root / "images" / "view_2.png"))[..., :3]
    shown = Thumbnails(scene, 4).of(scene.frames[2].name)
    assert step > 1
    np.testing.assert_array_equal(shown, picture[::step, ::step])
    assert Thumbnails(scene).of("another") is None


def test_a_view_without_a_picture_is_read_from_its_cube_in_part_and_once(folder, monkeypatch):
    monkeypatch.setattr(Scene, "srgb", lambda *_: None)
    scene = load_scene(folder.root)
    parts, read = [], Scene.cube
    monkeypatch.setattr(
        Scene, "cube", lambda self, index, part=(): (parts.append(part), read(self, index, part))[1]
    )
    images = Thumbnails(scene, 4)
    name = scene.frames[1].name
    first, second = images.of(name), images.of(name)
    assert first is second
    assert len(parts) == 1
    assert all(one.step > 1 for one in parts[0])
    assert first is not None
    assert first.shape[0] <= 8
    assert first.std() > 10  # a ball before black
