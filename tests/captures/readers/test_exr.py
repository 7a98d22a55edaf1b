"""Windows and parts of OpenEXR files, as OpenEXR's own library writes them."""

import numpy as np
import OpenEXR
import pytest

from tests.captures.file_factory import centres_nm
from unmix_plugin.captures.readers.opening import inspect_file, open_spectral_file
from unmix_plugin.captures.spectral_file import ReadOptions
from unmix_plugin.errors import CaptureError

HEIGHT, WIDTH = 9, 12
CUBE = np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float32)
NAMES = [f"S0.{nm}nm" for nm in (450, 550, 650)]


def channels(cube, names=NAMES):
    return {name: np.ascontiguousarray(cube[..., index]) for index, name in enumerate(names)}


def head(name="", window=None):
    """Header of a part whose data window (left, top, right, bottom) may differ from its picture."""
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    header |= {"name": name} if name else {}
    if window is not None:
        left, top, right, bottom = window
        corner, end = np.array([left, top], np.int32), np.array([right, bottom], np.int32)
        frame = np.zeros(2, np.int32), np.array([WIDTH - 1, HEIGHT - 1], np.int32)
        header |= {"dataWindow": (corner, end), "displayWindow": frame}
    return header


def write(path, *parts):
    OpenEXR.File([OpenEXR.Part(header, own) for header, own in parts]).write(str(path))
    return path


def test_a_window_is_put_where_it_belongs_and_the_rest_is_missing(tmp_path):
    inside = (slice(2, 7), slice(3, 11))
    header = head(window=(3, 2, 10, 6))
    OpenEXR.File(header, channels(CUBE[inside])).write(str(tmp_path / "a.exr"))
    file = open_spectral_file(tmp_path / "a.exr")
    assert file.shape == CUBE.shape
    expected = np.full(CUBE.shape, np.nan, np.float32)
    expected[inside] = CUBE[inside]
    np.testing.assert_array_equal(file.read(), expected)
    np.testing.assert_array_equal(file.read(slice(1, 4), np.array([2])), expected[1:4, :, [2]])


def test_what_is_rendered_beyond_the_picture_is_cut_off(tmp_path):
    beyond = np.random.default_rng(1).random((HEIGHT + 5, WIDTH + 4, 3)).astype(np.float32)
    OpenEXR.File(head(window=(-2, -3, WIDTH + 1, HEIGHT + 1)), channels(beyond)).write(
        str(tmp_path / "a.exr")
    )
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "a.exr").read(), beyond[3:-2, 2:-2])


def test_a_window_outside_of_the_picture_is_refused(tmp_path):
    header = head(window=(40, 0, 40 + WIDTH - 1, HEIGHT - 1))
    OpenEXR.File(header, channels(CUBE)).write(str(tmp_path / "a.exr"))
    with pytest.raises(CaptureError, match="outside of the picture"):
        open_spectral_file(tmp_path / "a.exr")


def test_bands_are_found_in_whichever_part_they_are(tmp_path):
    preview = channels(CUBE, "RGB")
    write(tmp_path / "a.exr", (head("rgba"), preview), (head("spectral"), channels(CUBE)))
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_array_equal(centres_nm(file), [450, 550, 650])
    np.testing.assert_array_equal(file.read(), CUBE)
    facts = inspect_file(tmp_path / "a.exr")
    assert [part["name"] for part in facts["metadata"]["parts"]] == ["rgba", "spectral"]
    assert sorted(facts["metadata"]["other_channels"]) == ["B", "G", "R"]
    named = open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="rgba"))
    np.testing.assert_array_equal(named.read(), CUBE)


def test_bands_of_several_parts_are_joined_each_at_its_own_window(tmp_path):
    parts = []
    expected = CUBE.copy()
    for index, name in enumerate(NAMES):
        window = (0, 0, WIDTH - 1, HEIGHT - 1) if index else (0, 1, WIDTH - 1, HEIGHT - 1)
        own = np.ascontiguousarray(CUBE[window[1] :, :, index])
        parts.append((head(f"band{index}", window), {name: own}))
    expected[0, :, 0] = np.nan
    file = open_spectral_file(write(tmp_path / "a.exr", *parts))
    np.testing.assert_array_equal(file.read(), expected)


def test_parts_that_are_left_out_are_said(tmp_path):
    same = write(tmp_path / "a.exr", (head("left"), channels(CUBE)), (head("right"), channels(CUBE / 2)))
    file = open_spectral_file(same)
    np.testing.assert_array_equal(file.read(), CUBE)
    assert "1 other parts have the same ones" in file.warnings[0]
    np.testing.assert_array_equal(open_spectral_file(same, ReadOptions(dataset="right")).read(), CUBE / 2)
    plain = write(
        tmp_path / "b.exr", (head("x"), channels(CUBE, "RGB")), (head("y"), {"Z": CUBE[..., 0].copy()})
    )
    assert "the file also has the parts y" in open_spectral_file(plain).warnings[0]


def test_the_exposure_is_that_of_its_attributes(tmp_path):
    header = head() | {"expTime": 0.25, "isoSpeed": 200.0}
    OpenEXR.File(header, channels(CUBE)).write(str(tmp_path / "a.exr"))
    metadata = open_spectral_file(tmp_path / "a.exr").metadata
    assert (metadata["exposure_s"], metadata["gain"]) == (0.25, 2.0)
