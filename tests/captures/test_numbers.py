"""What is compressed is decoded once a run, wherever its numbers are asked for, and nothing of it stays."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter

import h5py
import numpy as np
import pytest
import tifffile

from tests.factories.captures import HEIGHT, WAVELENGTHS_NM, WIDTH, process, write_poses
from unmix_plugin import limits
from unmix_plugin.captures import numbers
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.errors import CaptureError

CUBE = np.random.default_rng(0).integers(0, 4000, (HEIGHT, WIDTH, 9)).astype(np.uint16)
STRIP_ROWS = 4
STORED = {
    "samples": (CUBE, {"planarconfig": "contig"}),
    "planes": (CUBE.transpose(2, 0, 1), {"planarconfig": "separate"}),
    "pages": (CUBE.transpose(2, 0, 1), {}),
    "tiles": (CUBE, {"planarconfig": "contig", "tile": (16, 16)}),
}


@pytest.fixture
def decoded(monkeypatch):
    """How often each strip or tile of a TIFF was decoded, by where it lies."""
    counts: Counter[tuple[str, int]] = Counter()
    make_decode = tifffile.TiffPage.decode.func

    def counting(page):
        decode = make_decode(page)

        def counted(data, index, **options):
            counts[page.parent.filename, page.dataoffsets[index]] += 1
            return decode(data, index, **options)

        return counted

    monkeypatch.setattr(tifffile.TiffPage, "decode", property(counting))
    return counts


@pytest.fixture
def small_pieces(monkeypatch):
    """Each strip is a piece of its own."""
    monkeypatch.setattr(numbers, "_PIECE_BYTES", 1)


def write_tiff(path, cube, storage="samples", **options):
    if storage in ("planes", "pages"):
        cube = cube.transpose(2, 0, 1)
    given = {"compression": "zlib", "photometric": "minisblack", "metadata": None}
    given |= {"rowsperstrip": STRIP_ROWS} if storage != "tiles" else {}
    tifffile.imwrite(path, cube, **given, **STORED[storage][1], **options)
    return path


def test_a_whole_run_decodes_each_strip_once(tmp_path, decoded):
    root = tmp_path / "capture"
    root.mkdir()
    names = [f"view_{index}" for index in range(3)]
    for index, name in enumerate(names):
        description = f"wavelengths (nm): {', '.join(f'{nm:g}' for nm in WAVELENGTHS_NM)}"
        storage = list(STORED)[index]
        write_tiff(root / f"{name}.tif", CUBE // (index + 1), storage, description=description)
    write_poses(root / "transforms.json", names)
    process(root, tmp_path / "scene", mask="auto")
    num_strips = -(-HEIGHT // STRIP_ROWS)
    assert len(decoded) == num_strips + 2 * 9 * num_strips
    assert set(decoded.values()) == {1}


@pytest.mark.usefixtures("small_pieces")
@pytest.mark.parametrize("storage", STORED)
def test_any_rows_and_bands_are_right_however_small_the_pieces(tmp_path, storage, decoded):
    file = open_spectral_file(write_tiff(tmp_path / "a.tif", CUBE, storage))
    for rows, bands in (
        (slice(5, 7), slice(2, 4)),
        (slice(0, 24), np.array([8, 0])),
        (slice(3, 20), slice(9)),
    ):
        np.testing.assert_array_equal(file.read(rows, bands), CUBE[rows][..., bands])
    assert set(decoded.values()) == {1}


def test_chunks_of_hdf5_are_read_in_one_go(tmp_path, monkeypatch):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("cube", data=CUBE, chunks=(8, 16, 4), compression="gzip")
    opened, counts = open_spectral_file(tmp_path / "a.h5"), Counter()
    read = h5py.Dataset.__getitem__

    def counting(self, part, *more):
        counts[self.name] += 1
        return read(self, part, *more)

    monkeypatch.setattr(h5py.Dataset, "__getitem__", counting)
    for row in range(HEIGHT):
        np.testing.assert_array_equal(opened.read(slice(row, row + 1)), CUBE[row : row + 1])
    assert counts == {"/cube": 1}


def test_a_file_that_changed_is_decoded_again(tmp_path):
    path = write_tiff(tmp_path / "a.tif", CUBE)
    np.testing.assert_array_equal(open_spectral_file(path).read(), CUBE)
    write_tiff(path, CUBE[::-1].copy())
    os.utime(path, ns=(1, 1))
    np.testing.assert_array_equal(open_spectral_file(path).read(), CUBE[::-1])


def test_a_disk_without_room_is_said_before_anything_is_decoded(tmp_path, monkeypatch, decoded):
    file = open_spectral_file(write_tiff(tmp_path / "a.tif", CUBE))
    monkeypatch.setattr(limits.shutil, "disk_usage", lambda _: tempfile_usage(free=1000))
    with pytest.raises(
        CaptureError, match=r"13,824 bytes are needed to decode it .* 1,000 are free; .*TMPDIR"
    ):
        file.read()
    assert not decoded


def tempfile_usage(free):
    return type("Usage", (), {"free": free})()


def test_what_a_full_disk_had_no_place_for_is_decoded_again(tmp_path, monkeypatch, decoded):
    """Two files of which only one has room are both right."""
    first, second = (open_spectral_file(write_tiff(tmp_path / name, CUBE)) for name in ("a.tif", "b.tif"))
    np.testing.assert_array_equal(first.read(), CUBE)
    left = iter([0])
    monkeypatch.setattr(limits, "has_scratch_room", lambda *_: True)
    monkeypatch.setattr(numbers, "has_scratch_room", lambda *_: next(left, 1) > 0)
    np.testing.assert_array_equal(second.read(), CUBE)
    np.testing.assert_array_equal(first.read(), CUBE)
    assert sorted(set(decoded.values())) == [1, 2]


@pytest.mark.skipif(os.name == "nt", reason="a file without a name is one that is unlinked")
def test_the_scratch_file_has_no_name_that_could_stay(tmp_path):
    path, scratch = write_tiff(tmp_path / "a.tif", CUBE), tmp_path / "scratch"
    scratch.mkdir()
    code = (
        "import sys; from pathlib import Path\n"
        "from unmix_plugin.captures.readers.opening import open_spectral_file\n"
        "values = open_spectral_file(Path(sys.argv[1])).read()\n"
        "print(values.sum(), len(list(Path(sys.argv[2]).iterdir())))"
    )
    words = [sys.executable, "-c", code, str(path), str(scratch)]
    environment = {**os.environ, "TMPDIR": str(scratch)}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [str(CUBE.sum()), "0"]
