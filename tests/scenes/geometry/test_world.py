from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.factories.ball_views import make_cameras
from tests.factories.demo_parts import one_ray_a_pixel
from tests.factories.scenes import look_at
from unmix_plugin.engine.geometry.space import SceneBox, UnitSpace
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.demo.scene import PLACES, make_demo_scene
from unmix_plugin.scenes.geometry.carving import carve
from unmix_plugin.scenes.geometry.view_agreement import WorldEvidence
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions

BOX = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("places")
    with one_ray_a_pixel():
        for name, size in (("table", 48), ("world", 48), ("room", 72)):
            make_demo_scene(root / name, size, 3, 16, place=PLACES[name])
    return root


@pytest.mark.parametrize(("name", "is_unbounded"), [("table", False), ("world", True), ("room", True)])
def test_what_goes_on_behind_the_box_is_found_from_the_views(folders, name, is_unbounded):
    scene = load_scene(folders / name)
    assert scene.has_alpha == (name == "table")
    assert scene.is_unbounded == is_unbounded
    said = scene.world_reason
    assert (said is None) == scene.has_alpha
    assert said is None or "taken to go on behind the scene box" in said
    as_told = load_scene(folders / name, SceneOptions(world="bounded"))
    assert not as_told.is_unbounded
    assert as_told.world_reason is None


def test_a_world_goes_on_where_pixels_or_matched_places_tell_of_more_than_a_closed_box():
    closed = WorldEvidence(num_pixels=1000, num_inside=900, num_behind=20, num_explained=850)
    assert not closed.goes_on
    assert not WorldEvidence(0, 0, 0, 0).goes_on
    assert replace(closed, num_inside=600, num_behind=300).goes_on
    assert replace(closed, num_inside=900, num_behind=80).goes_on  # walls that few views see, beyond the box
    assert replace(closed, num_inside=300, num_behind=10, num_explained=350).goes_on
    assert "end with its box" in closed.in_words()
    within, beyond = torch.tensor([0.5, -0.9, 1.1]), torch.tensor([0.0, 2.0, 0.0])
    for num_beyond, said in ((1, "1 of 10 places matched"), (2, "go on behind the scene box: 2")):
        found = closed.with_places(BOX, torch.stack([within] * (10 - num_beyond) + [beyond] * num_beyond))
        assert found.goes_on == (num_beyond == 2)
        assert said in found.in_words()


def test_a_world_behind_what_is_transparent_is_refused(folders):
    with pytest.raises(SceneError, match="world: is unbounded, but pictures have alpha"):
        load_scene(folders / "table", SceneOptions(world="unbounded"))


@pytest.fixture
def world(folders):
    """A scene whose world goes on behind the box, for other cameras."""
    return replace(load_scene(folders / "world"), scene_box=BOX, is_unbounded=True)


def test_cells_that_one_view_alone_sees_are_carved_and_those_that_many_see_are_not(world):
    """Two cameras side by side see the same far places, and each what is right before it alone."""
    positions = [np.array([3.0, side, 0.3]) for side in (-1.0, 1.0)]
    cameras = make_cameras([look_at(position, np.array([-20.0, 0.0, 0.0])) for position in positions])
    kept = carve(world, 32, cameras=cameras)
    points = torch.tensor([[0.0, 0.0, 0.0], [-30.0, 0.0, 0.0], [2.2, -1.0, 0.3], [8.0, 0.0, 0.0]])
    cells = (UnitSpace(BOX, is_unbounded=True).to_unit(points) * 32).long()
    assert kept[tuple(cells.T.numpy())].tolist() == [True, True, False, False]


@pytest.mark.parametrize(("beside", "is_kept"), [(0, False), (1, False), (2, True)])
def test_what_is_near_a_camera_must_be_seen_by_others_from_its_side(world, beside, is_kept):
    """Views from the other side see the place too, but hold nothing that fits the nearest picture alone."""
    nearest = [np.array([3.0, 0.2 * index, 0.3]) for index in range(1 + beside)]
    opposite = [np.array([-3.0, side, 0.3]) for side in (-0.6, -0.2, 0.2, 0.6)]
    cameras = make_cameras([look_at(position, np.zeros(3)) for position in nearest + opposite])
    place = UnitSpace(BOX, is_unbounded=True).to_unit(torch.tensor([1.5, 0.02, 0.16]))
    assert carve(world, 32, cameras=cameras)[tuple((place * 32).long())] == is_kept
