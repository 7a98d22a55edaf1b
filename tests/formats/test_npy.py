"""Arrays written row after row."""

import numpy as np
import pytest

from tests.formats.cubes import full_disk, random_cube
from unmix_plugin.errors import RunError
from unmix_plugin.formats.files import npy_rows


def test_rows_in_blocks_are_the_array_that_numpy_loads(tmp_path):
    cube = random_cube()
    with npy_rows(tmp_path / "a" / "x.npy", cube.shape, np.float32) as add:
        add(cube[:6])
        add(cube[6:].astype(np.float64))
    read = np.load(tmp_path / "a" / "x.npy", allow_pickle=False)
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, cube)


def test_ids_without_channels_are_written_too(tmp_path):
    ids = np.arange(12, dtype=np.uint8).reshape(3, 4)
    with npy_rows(tmp_path / "x.npy", (3, 4), np.uint8) as add:
        add(ids)
    np.testing.assert_array_equal(np.load(tmp_path / "x.npy"), ids)


def test_a_disk_that_fills_up_half_way_leaves_nothing(tmp_path, monkeypatch):
    cube = random_cube()
    full_disk(monkeypatch, after=128 + cube[:3].nbytes)

    def write():
        with npy_rows(tmp_path / "x.npy", cube.shape, np.float32) as add:
            add(cube[:3])
            add(cube[3:])

    with pytest.raises(RunError, match=r"can't write .*x\.npy: No space left on device"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_an_error_between_rows_leaves_nothing_and_passes_through(tmp_path):
    def write():
        with npy_rows(tmp_path / "x.npy", (7, 5, 5), np.float32) as add:
            add(random_cube()[:3])
            raise OSError("of something else")

    with pytest.raises(OSError, match="of something else"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_rows_of_another_width_are_refused(tmp_path):
    with (
        pytest.raises(ValueError, match=r"rows of x.npy have shape \(5, 5\); got \(4, 5\)"),
        npy_rows(tmp_path / "x.npy", (7, 5, 5), np.float32) as add,
    ):
        add(random_cube(width=4))
