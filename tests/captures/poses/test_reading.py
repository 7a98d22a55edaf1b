""""""

import numpy as np
import pytest

from tests.captures.poses.pose_factory import assert_same_poses, llff_table, ring
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import CaptureError


def write(tmp_path, **options):
    np.save(tmp_path / "poses_bounds.npy", llff_table(ring().values(), **options))
    return tmp_path / "poses_bounds.npy"


def test_axes_are_turned_and_names_are_those_of_the_pictures(tmp_path):
    path = write(tmp_path)
    (tmp_path / "images").mkdir()
    for index in range(6):
        (tmp_path / f"images/view_{index}.png").touch()
    for place in (path, tmp_path):
        found = read_poses(place)
        assert_same_poses(found, ring())
    lens = found.cameras["images/view_0.png"].lens
    assert lens is not None
    assert (lens.width, lens.height, lens.focal_px, lens.center_px) == (640, 480, (500, 500), (320, 240))


def test_poses_without_pictures_go_by_order(tmp_path):
    assert list(read_poses(write(tmp_path)).cameras) == [f"#{index:04d}" for index in range(6)]


def test_other_arrays_and_damaged_files_are_refused(tmp_path):
    path = write(tmp_path, hwf=(480.0, 640.0, -1.0))
    with pytest.raises(CaptureError, match="focal length 480, 640, -1"):
        read_poses(path)
    np.save(path, np.zeros((3, 4)))
    with pytest.raises(CaptureError, match=r"shape \(3, 4\)"):
        read_poses(path)
    np.save(path, np.array([{"a": 1}]), allow_pickle=True)
    with pytest.raises(CaptureError, match="never loaded"):
        read_poses(path)
    path.write_bytes(write(tmp_path).read_bytes()[:300])
    with pytest.raises(CaptureError, match="is cut short"):
        read_poses(path)
