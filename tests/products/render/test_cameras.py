"""Which cameras are chosen."""

import itertools
from dataclasses import replace

import pytest

from tests.factories.cameras import around, cameras_at, record
from tests.factories.models import make_scene
from tests.factories.scenes import ring_poses
from unmix_plugin.errors import ConfigError
from unmix_plugin.products.render import RenderOptions
from unmix_plugin.products.render.cameras import choose_cameras
from unmix_plugin.trained.camera_files import camera_file_bytes
from unmix_plugin.trained.run_views import recorded_views, world_frame

RECORD = record(around(6), cameras_at(ring_poses(3)))
SCENE = replace(make_scene(), views=recorded_views(RECORD), frame=world_frame(RECORD))


def chosen(**request):
    return choose_cameras(SCENE, RenderOptions(**request))


def names(cameras):
    return [view.name for view in cameras.views]


def test_views_of_the_dataset_keep_their_names_and_are_no_path():
    found = chosen()
    assert names(found) == ["view_6", "view_7", "view_8"]
    assert names(chosen(cameras="dataset-train")) == [f"view_{index}" for index in range(6)]
    assert not found.is_path
    assert found.views[1].camera.camera_to_world.equal(RECORD.eval_cameras.camera_to_world[1:2])


@pytest.mark.parametrize("source", ["orbit", "interpolate"])
def test_paths_have_as_many_frames_as_asked_for_of_at_least_512_rows_or_the_size_asked_for(source):
    cameras = chosen(cameras=source, frames=7)
    assert names(cameras) == [f"{source}_{index:04d}" for index in range(7)]
    assert cameras.is_path
    assert cameras.size == (683, 512)
    assert len(chosen(cameras=source).views) == 120
    assert chosen(cameras=source, frames=2, downscale=1.0).size == (40, 30)
    assert chosen(cameras=source, frames=2, size="20x16").size == (20, 16)


def test_views_are_picked_by_name_or_number_and_keep_their_order():
    assert names(chosen(view=("view_8", "0"))) == ["view_6", "view_8"]
    assert names(chosen(cameras="orbit", frames=5, view=("3",))) == ["orbit_0003"]


def test_a_file_gives_the_cameras_written_in_it(tmp_path):
    path = tmp_path / "mine.json"
    path.write_bytes(camera_file_bytes(chosen(cameras="orbit", frames=4).views, 12.0, SCENE.frame))
    found = chosen(cameras=str(path))
    assert names(found) == [f"orbit_{index:04d}" for index in range(4)]
    assert (found.is_path, found.frames_per_second) == (True, 12.0)
    assert chosen(cameras=str(path), fps=30.0).frames_per_second == 30.0


def test_size_and_downscale_change_all_views():
    for request, size in (
        ({"size": "64x48"}, (64, 48)),
        ({"downscale": 2.0}, (20, 15)),
        ({"downscale": 0.5}, (80, 60)),
        ({}, (40, 30)),
    ):
        cameras = chosen(**request)
        assert cameras.size == size
        assert {(view.camera.width, view.camera.height) for view in cameras.views} == {size}


BAD = [
    ({"cameras": "orbti"}, r"unknown cameras 'orbti' \(did you mean orbit\?\); known are dataset-eval"),
    ({"cameras": "xyz"}, "unknown cameras 'xyz'; known are"),
    ({"cameras": "none.json"}, "can't read the camera file none.json"),
    ({"frames": 5}, "--frames is for the paths that are made here, orbit and interpolate"),
    ({"cameras": "orbit", "frames": 0}, "--frames 0: expected 1 to 100000"),
    ({"cameras": "orbit", "frames": 10**9}, "--frames 1000000000"),
    ({"view": ("view_9",)}, r"no view 'view_9' \(did you mean view_8 or"),
    ({"view": ("3",)}, "no view '3'; give a number from 0 to 2, or a name such as view_6"),
    ({"size": "4x4", "downscale": 2.0}, "--size and --downscale both say"),
    ({"size": "0x4"}, "--size: 0 x 4 pixels"),
    ({"size": "20000x4"}, "--size: 20000 x 4 pixels; expected whole numbers from 1 to 16384"),
    ({"downscale": 0.0}, "--downscale 0: expected 0.001 to 1000"),
    ({"downscale": float("nan")}, "--downscale nan"),
    ({"downscale": 100.0}, "--downscale 100: 0 x 0 pixels"),
    ({"fps": -1.0}, "--fps: -1.0 frames a second"),
    ({"fps": float("nan")}, "--fps: nan frames a second"),
]


@pytest.mark.parametrize(("request_", "said"), BAD)
def test_what_cannot_be_rendered_is_refused(request_, said):
    with pytest.raises(ConfigError, match=said):
        chosen(**request_)


def test_views_of_several_sizes_are_rendered_as_large_as_the_largest():
    sizes = itertools.cycle([(20, 15), (40, 30), (10, 10)])
    views = (replace(view, camera=view.camera.resized(*next(sizes))) for view in SCENE.views)
    rig = replace(SCENE, views=tuple(views))
    cameras = choose_cameras(rig, RenderOptions())
    assert [view.camera.size(0) for view in cameras.views] == [(40, 30)] * 3
    for source in ("orbit", "interpolate"):
        path = choose_cameras(rig, RenderOptions(cameras=source, frames=2, downscale=2.0))
        assert len({view.camera.size(0) for view in path.views}) == 1
