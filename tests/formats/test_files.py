"""Files whole or not at all, nothing lost by accident; arrays row after row; PNG by imageio and Pillow."""

import errno
import os
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.factories.cubes import full_disk, random_cube
from unmix_plugin.engine.runs import atomic_files, replacing
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.formats.files import (
    NOT_PLAIN,
    NOT_PORTABLE,
    array_bytes,
    indexed_png_bytes,
    make_folder,
    npy_rows,
    refuse_to_overwrite,
    rgba_png_bytes,
    safe_name,
    write_file,
)

PORTS = {f"{port}{digit}" for port in ("com", "lpt") for digit in "123456789"}
DEVICES = {"con", "prn", "aux", "nul"} | PORTS
NASTY = ["con", "NUL", "aux.txt", "com1", ".", " ", ":", "\\", "/", "\0", "a", "\u00e9", "e\u0301", "-"]
NAMES = st.one_of(st.text(max_size=150), st.lists(st.sampled_from(NASTY), max_size=6).map("".join))


@pytest.mark.parametrize(
    ("number", "advice"),
    [(errno.ENOSPC, "No space left on device; make room"), (errno.EFBIG, r"File too large; .*ulimit -f")],
)
def test_a_full_disk_keeps_the_old_file_and_says_what_to_do(tmp_path, monkeypatch, number, advice):
    def full(*_args):
        raise OSError(number, os.strerror(number))

    old = array_bytes(np.arange(3))
    path = write_file(tmp_path / "made" / "file.npy", old)
    np.testing.assert_array_equal(np.load(path), [0, 1, 2])
    monkeypatch.setattr(os, "write", full)
    with pytest.raises(RunError, match=f"can't write .*file.npy: {advice}"):
        write_file(path, b"new")
    assert [file.read_bytes() for file in path.parent.glob("[!.]*")] == [old]


def test_a_file_that_somebody_reads_is_replaced_once_it_is_free(tmp_path, monkeypatch):
    """Windows replaces no file that is open."""
    path, replace = write_file(tmp_path / "file", b"old"), Path.replace
    refusals = [PermissionError(errno.EACCES, "someone reads")] * 2

    def busy(self, target):
        if refusals:
            raise refusals.pop()
        return replace(self, target)

    monkeypatch.setattr(replacing, "_READERS_S", (0.0, 0.0, 0.0))
    monkeypatch.setattr(Path, "replace", busy)
    write_file(path, b"new")
    assert path.read_bytes() == b"new"
    refusals.extend([PermissionError(errno.EACCES, "someone reads")] * 9)
    with pytest.raises(RunError, match=r"can't write .*file: Permission denied; choose a folder"):
        write_file(path, b"newer")


def test_existing_files_are_counted_and_refused_unless_overwriting_was_asked_for(tmp_path):
    paths = [tmp_path / name for name in "abc"]
    refuse_to_overwrite(paths, overwrite=False)
    for path in paths[1:]:
        path.write_bytes(b"")
    with pytest.raises(ConfigError, match=r"b and 1 more of its files exist already; give --overwrite"):
        refuse_to_overwrite(paths, overwrite=False)
    paths[1].unlink()
    with pytest.raises(ConfigError, match=r"c exists already; give --overwrite or another folder"):
        refuse_to_overwrite(paths, overwrite=False)
    with pytest.raises(RunError, match=r"c is in the way: unmix-nerf did not write it"):
        refuse_to_overwrite(paths, overwrite=True)
    paths[2].unlink()
    write_file(paths[2], b"ours")
    refuse_to_overwrite(paths, overwrite=True)


@pytest.mark.parametrize("values", [random_cube(), np.arange(12, dtype=np.uint8).reshape(3, 4)])
def test_rows_in_blocks_are_the_array_that_numpy_loads(tmp_path, values):
    with npy_rows(tmp_path / "x.npy", values.shape, values.dtype.type) as add:
        add(values[:2])
        add(values[2:].astype(np.float64))
    assert np.load(tmp_path / "x.npy").dtype == values.dtype
    np.testing.assert_array_equal(np.load(tmp_path / "x.npy"), values)


def test_what_goes_wrong_between_rows_leaves_nothing(tmp_path, monkeypatch):
    cube = random_cube()

    def write(*parts):
        with npy_rows(tmp_path / "x.npy", cube.shape, np.float32) as add:
            for part in parts:
                add(part)
            raise OSError("of something else")

    with pytest.raises(OSError, match="of something else"):
        write(cube[:3])
    with pytest.raises(ValueError, match=r"rows of x.npy have shape \(5, 5\); got \(4, 5\)"):
        write(random_cube(width=4))
    full_disk(monkeypatch, after=128 + cube[:3].nbytes)
    with pytest.raises(RunError, match=r"can't write .*x\.npy: No space left on device"):
        write(cube[:3], cube[3:])
    assert list(tmp_path.iterdir()) == []


def test_colours_and_opacity_are_read_back_as_they_were(tmp_path):
    rgba = np.random.default_rng(0).integers(0, 256, (6, 9, 4), dtype=np.uint8)
    (tmp_path / "x.png").write_bytes(rgba_png_bytes(rgba, "what it is"))
    np.testing.assert_array_equal(iio.imread(tmp_path / "x.png"), rgba)
    with Image.open(tmp_path / "x.png") as picture:
        assert picture.info["Description"] == "what it is"


def test_a_picture_of_ids_is_ids_and_colours_in_one(tmp_path):
    ids = np.array([[0, 1, 2], [255, 7, 1]], dtype=np.uint8)
    palette = np.random.default_rng(0).random((256, 3))
    (tmp_path / "x.png").write_bytes(indexed_png_bytes(ids, palette, transparent=255))
    with Image.open(tmp_path / "x.png") as picture:
        assert picture.mode == "P"
        np.testing.assert_array_equal(np.asarray(picture), ids)
        rgba = np.asarray(picture.convert("RGBA"))
    np.testing.assert_array_equal(rgba[..., :3], np.round(palette[ids] * 255))
    np.testing.assert_array_equal(rgba[..., 3] == 0, ids == 255)


@given(NAMES, st.sampled_from([NOT_PLAIN, NOT_PORTABLE]))
def test_a_safe_name_is_one_on_every_system_and_safe_names_stay(name, unfit):
    safe = safe_name(name, unfit)
    assert safe.isprintable()
    assert not set(safe) & set('<>:"/\\|?*')
    assert safe == safe.strip(". ") != ""
    assert safe.partition(".")[0].rstrip().lower() not in DEVICES
    assert len(safe.encode()) <= 110
    assert safe_name(safe, unfit) == safe


def test_devices_streams_and_trailing_dots_of_windows_are_no_names():
    names = ("CON", "aux.txt", "com\u00b9", "console", "C:leaf", "leaf. . ", "Bl\u00e4tter", " . ")
    safe = ["_CON", "_aux.txt", "_com\u00b9", "console", "C_leaf", "leaf", "Bl\u00e4tter", "unnamed"]
    assert list(map(safe_name, names)) == safe
    assert safe_name("\u6e2f" * 90 + "a") != safe_name("\u6e2f" * 90 + "b")  # long ones stay different


@pytest.mark.parametrize(
    "writes", [lambda path: write_file(path, b""), lambda path: make_folder(path / "more")]
)
def test_a_path_too_long_for_windows_is_said_to_be_that(tmp_path, monkeypatch, writes):
    """Its own words are that there is no such file or folder."""
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match=r"can't make the folder .*choose"):
        writes(tmp_path / "file" / "name")
    with pytest.raises(RunError, match="File name too long; choose a shorter name"):
        write_file(tmp_path / ("a" * 256), b"")
    monkeypatch.setattr(atomic_files, "LONGEST_PATH", 12)
    with pytest.raises(RunError, match="more than 12 letters: choose a shorter folder, or turn on"):
        writes(tmp_path / "file" / "name")
