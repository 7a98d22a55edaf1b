"""OpenEXR files as its own library writes them: channels, windows and parts."""

import numpy as np
import OpenEXR
import pytest

from tests.captures.file_factory import centres_nm, widths_nm
from unmix_plugin.captures.readers.opening import inspect_file, open_spectral_file
from unmix_plugin.captures.spectral_file import ReadOptions
from unmix_plugin.errors import CaptureError
from unmix_plugin.formats.exr import write_spectral_exr
from unmix_plugin.spectral.bands import Bands

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


def opened(path, header, own):
    OpenEXR.File(header, own).write(str(path))
    return open_spectral_file(path)


RNG = np.random.default_rng(0)


def write_random(path, names, dtype="f4"):
    """Channels of 4 x 6 pixels, each with numbers of its own, as they are read back."""
    OpenEXR.File(head(), {name: RNG.random((4, 6)).astype(dtype) for name in names}).write(str(path))
    read = OpenEXR.File(str(path), separate_channels=True).channels()
    return {name: np.array(read[name].pixels) for name in names}


@pytest.mark.parametrize(
    ("names", "nm"),
    [
        (["S0.1000,000000nm", "S0.450,000000nm", "S0.460,500000nm"], [450, 460.5, 1000]),
        (["T.380,0nm", "T.390,0nm"], [380, 390]),
        (["S0.0,55um", "S0.450nm"], [450, 550]),
        (["T.600,0THz", "T.500,0THz"], [499.654097, 599.584916]),
        (["700", "450", "550.5"], [450, 550.5, 700]),
    ],
)
@pytest.mark.parametrize("dtype", ["f4", "f2"])
def test_channels_are_bands_by_rising_wavelength(tmp_path, names, nm, dtype):
    channels = write_random(tmp_path / "a.exr", [*names, "R", "G", "B"], dtype)
    file = open_spectral_file(tmp_path / "a.exr")
    assert (file.shape, file.dtype) == ((4, 6, len(nm)), np.dtype(dtype))
    np.testing.assert_allclose(centres_nm(file), nm, atol=1e-5)
    for band, name in enumerate(file.bands.names or ()):
        np.testing.assert_array_equal(file.read(bands=np.array([band]))[..., 0], channels[name])
    np.testing.assert_array_equal(file.read(slice(1, 3)), file.read()[1:3])
    assert file.metadata["other_channels"] == ["B", "G", "R"]


def test_ranges_of_mitsuba(tmp_path):
    channels = write_random(tmp_path / "a.exr", ["407.00-454.00nm", "360.00-407.00nm"])
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_allclose(centres_nm(file), [383.5, 430.5])
    np.testing.assert_allclose(widths_nm(file), [47, 47])
    np.testing.assert_array_equal(file.read()[..., 0], channels["360.00-407.00nm"])


def test_what_this_package_writes_is_read(tmp_path):
    spectra = RNG.random((3, 5, 2)).astype(np.float32)
    write_spectral_exr(tmp_path / "a.exr", spectra, Bands.of([450, 550.25]), spectra[..., [0, 1, 1]])
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_array_equal(file.read(), spectra)
    np.testing.assert_array_equal(centres_nm(file), [450, 550.25])
    assert file.metadata["emissiveUnits"] == "W.m^-2.sr^-1"


def test_one_of_several_layers_is_taken_or_named(tmp_path):
    channels = write_random(tmp_path / "a.exr", ["S1.450,0nm", "S0.450,0nm", "T.450,0nm"])
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_array_equal(file.read()[..., 0], channels["S0.450,0nm"])
    assert "layer 'S0' is taken; the file also has" in file.warnings[0]
    file = open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="T"))
    np.testing.assert_array_equal(file.read()[..., 0], channels["T.450,0nm"])
    with pytest.raises(CaptureError, match="no layer, part or channel 'S3'"):
        open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="S3"))


def test_channels_of_two_wavelengths_are_left_out(tmp_path):
    write_random(tmp_path / "a.exr", ["T.380,000000nm.410,000000nm", "T.380,000000nm", "T.410,000000nm"])
    file = open_spectral_file(tmp_path / "a.exr")
    np.testing.assert_array_equal(centres_nm(file), [380, 410])
    assert (file.notes, file.metadata["other_channels"]) == ((), ["T.380,000000nm.410,000000nm"])


def test_channels_without_wavelengths_are_bands_without_them(tmp_path):
    channels = write_random(tmp_path / "a.exr", ["s0", "s1", "A"])
    file = open_spectral_file(tmp_path / "a.exr")
    assert file.bands.names == ("s0", "s1")
    assert file.bands.wavelengths_nm is None
    named = open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="s1"))
    np.testing.assert_array_equal(named.read()[..., 0], channels["s1"])
    channels = write_random(tmp_path / "rgb.exr", ["R", "G", "B"])
    np.testing.assert_array_equal(open_spectral_file(tmp_path / "rgb.exr").read()[..., 0], channels["R"])
    write_random(tmp_path / "counted.exr", ["1", "2", "3"])
    assert open_spectral_file(tmp_path / "counted.exr").bands.wavelengths_nm is None


def test_files_that_are_cut_short_are_refused(tmp_path):
    write_random(tmp_path / "a.exr", ["S0.450,0nm", "S0.460,0nm"])
    data = (tmp_path / "a.exr").read_bytes()
    for length in range(4, len(data) - 1, 7):
        (tmp_path / "b.exr").write_bytes(data[:length])
        with pytest.raises(CaptureError, match=r"b\.exr"):
            open_spectral_file(tmp_path / "b.exr").read()


def test_damaged_numbers_are_reported_in_the_error_alone(tmp_path, capsys):
    write_random(tmp_path / "a.exr", ["S0.450,0nm", "S0.460,0nm"])
    data = bytearray((tmp_path / "a.exr").read_bytes())
    data[-200:-190] = bytes(10)  # the head of the only chunk
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(CaptureError, match=r"a\.exr: damaged: "):
        open_spectral_file(tmp_path / "a.exr").read()
    assert capsys.readouterr().out == ""


def test_a_window_is_put_where_it_belongs_and_the_rest_is_missing(tmp_path):
    inside = (slice(2, 7), slice(3, 11))
    file = opened(tmp_path / "a.exr", head(window=(3, 2, 10, 6)), channels(CUBE[inside]))
    assert file.shape == CUBE.shape
    expected = np.full(CUBE.shape, np.nan, np.float32)
    expected[inside] = CUBE[inside]
    np.testing.assert_array_equal(file.read(), expected)
    np.testing.assert_array_equal(file.read(slice(1, 4), np.array([2])), expected[1:4, :, [2]])


def test_what_is_rendered_beyond_the_picture_is_cut_off(tmp_path):
    beyond = np.random.default_rng(1).random((HEIGHT + 5, WIDTH + 4, 3)).astype(np.float32)
    file = opened(tmp_path / "a.exr", head(window=(-2, -3, WIDTH + 1, HEIGHT + 1)), channels(beyond))
    np.testing.assert_array_equal(file.read(), beyond[3:-2, 2:-2])
    corners = r"\[\[40, 0\], \[51, 8\]\] lies outside of the picture \[\[0, 0\], \[11, 8\]\]"
    with pytest.raises(CaptureError, match=corners):
        opened(tmp_path / "b.exr", head(window=(40, 0, 40 + WIDTH - 1, HEIGHT - 1)), channels(CUBE))


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
    parts, expected = [], CUBE.copy()
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
    metadata = opened(tmp_path / "a.exr", header, channels(CUBE)).metadata
    assert (metadata["exposure_s"], metadata["gain"]) == (0.25, 2.0)


@pytest.mark.parametrize(("form", "has_nm"), [("w{:g}nm", True), ("w{:g}", True), ("band{}", False)])
def test_channels_of_other_names_are_bands_in_the_order_of_their_numbers(tmp_path, form, has_nm):
    nm = [800.0, 900.0, 1000.0, 1100.0]
    names = [form.format(value if has_nm else place + 8) for place, value in enumerate(nm)]  # 10 after 9
    planes = {name: np.full((4, 5), value, np.float32) for name, value in zip(names, nm, strict=True)}
    header = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(header, planes).write(str(tmp_path / "a.exr"))
    file = open_spectral_file(tmp_path / "a.exr")
    assert file.bands.names == tuple(names)
    np.testing.assert_array_equal(file.read()[0, 0], nm)
    if has_nm:
        np.testing.assert_array_equal(centres_nm(file), nm)
    else:
        assert file.bands.wavelengths_nm is None
