"""OpenEXR files as its own library writes them: channels, windows and parts."""

import numpy as np
import OpenEXR
import pytest

from tests.factories.files import check_file, rows_and_bands_of
from unmix_plugin.captures.calibration.references import stated_reflectance
from unmix_plugin.captures.cube import ReadOptions
from unmix_plugin.captures.readers.opening import open_spectral_file
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


RNG = np.random.default_rng(0)


def write_random(path, names, dtype="f4"):
    """Channels of 4 x 6 pixels, each with numbers of its own, as they are read back."""
    OpenEXR.File(head(), {name: RNG.random((4, 6)).astype(dtype) for name in names}).write(str(path))
    read = OpenEXR.File(str(path), separate_channels=True).channels()
    return {name: np.array(read[name].pixels) for name in names}


@pytest.mark.parametrize(
    ("ordered", "nm", "stored"),
    [
        (["S0.450,000000nm", "S0.460,500000nm", "S0.1000,000000nm"], [450, 460.5, 1000], (2, 0, 1)),
        (["S0.450nm", "S0.0,55um"], [450, 550], (1, 0)),
        (["S0.4,5e-07m", "S0.6E2nm"], [450, 600], (0, 1)),
        (["450", "550.5", "700"], [450, 550.5, 700], (2, 0, 1)),
        (["w800nm", "w900nm", "w1000nm"], [800, 900, 1000], (0, 2, 1)),
        (["w800", "w900", "w1000"], [800, 900, 1000], (0, 2, 1)),
        (["band8", "band9", "band10"], None, (0, 2, 1)),
    ],
)
@pytest.mark.parametrize("dtype", ["f4", "f2"])
def test_channels_are_bands_by_rising_wavelength_or_number(tmp_path, ordered, nm, stored, dtype):
    others = [] if ordered[0][0] in "wb" else ["B", "G", "R"]  # beside names that the format knows
    channels = write_random(tmp_path / "a.exr", [*(ordered[i] for i in stored), *others], dtype)
    file = open_spectral_file(tmp_path / "a.exr")
    check_file(file, nm=nm, names=ordered)
    assert file.others.get("other_channels", []) == others
    rows_and_bands_of(file, np.stack([channels[name] for name in ordered], axis=-1))


def test_ranges_of_mitsuba_have_widths_and_channels_of_two_wavelengths_are_left_out(tmp_path):
    channels = write_random(tmp_path / "a.exr", ["407.00-454.00nm", "360.00-407.00nm"])
    first = channels["360.00-407.00nm"]
    file = open_spectral_file(tmp_path / "a.exr")
    check_file(file, nm=[383.5, 430.5], fwhm=47)
    np.testing.assert_array_equal(file.read()[..., 0], first)
    write_random(tmp_path / "a.exr", ["T.380,000000nm.410,000000nm", "T.380,000000nm", "T.410,000000nm"])
    other = ["T.380,000000nm.410,000000nm"]
    check_file(open_spectral_file(tmp_path / "a.exr"), nm=[380, 410], notes=(), other_channels=other)


def test_channels_named_by_frequencies_are_refused_with_what_to_do(tmp_path):
    write_random(tmp_path / "a.exr", ["T.600,0THz", "T.500,0THz", "R"])
    with pytest.raises(
        CaptureError, match="named by a frequency, which is not read; name channels by wavelengths"
    ):
        open_spectral_file(tmp_path / "a.exr")


def test_one_of_several_layers_is_taken_or_named(tmp_path):
    channels = write_random(tmp_path / "a.exr", ["S1.450,0nm", "S0.450,0nm", "T.450,0nm"])
    said = "layer 'S0' is taken; the file also has"
    check_file(open_spectral_file(tmp_path / "a.exr"), values=channels["S0.450,0nm"][..., None], warning=said)
    named = open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="T"))
    check_file(named, values=channels["T.450,0nm"][..., None])
    assert stated_reflectance(named) == "the layer T"
    assert stated_reflectance(open_spectral_file(tmp_path / "a.exr")) is None
    with pytest.raises(CaptureError, match="no layer, part or channel 'S3'"):
        open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="S3"))


def test_between_layers_of_unknown_names_the_user_chooses(tmp_path):
    channels = write_random(tmp_path / "a.exr", ["beauty.450nm", "albedo.450nm", "specular.450nm"])
    with pytest.raises(
        CaptureError, match=r"3 layers hold wavelengths \(albedo, beauty, specular\).*--dataset"
    ):
        open_spectral_file(tmp_path / "a.exr")
    named = open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="specular"))
    check_file(named, values=channels["specular.450nm"][..., None])
    channels = write_random(tmp_path / "b.exr", ["beauty.450nm", "albedo.450nm", "450nm"])
    said = "layer '' is taken; the file also has 'albedo', 'beauty'"
    check_file(open_spectral_file(tmp_path / "b.exr"), values=channels["450nm"][..., None], warning=said)


def test_channels_without_wavelengths_are_bands_without_them(tmp_path):
    channels = write_random(tmp_path / "a.exr", ["s0", "s1", "A"])
    check_file(open_spectral_file(tmp_path / "a.exr"), names=["s0", "s1"], nm=None)
    named = open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="s1"))
    check_file(named, values=channels["s1"][..., None])
    for names in ("RGB", [f"View.Combined.{name}" for name in "RGB"], ["key.red", "key.green", "key.blue"]):
        channels = write_random(tmp_path / "rgb.exr", list(names))
        colours = np.stack([channels[name] for name in names], axis=-1)
        check_file(open_spectral_file(tmp_path / "rgb.exr"), values=colours)
    write_random(tmp_path / "counted.exr", ["1", "2", "3"])
    check_file(open_spectral_file(tmp_path / "counted.exr"), nm=None)


def test_damaged_numbers_are_reported_in_the_error_alone(tmp_path, capsys):
    write_random(tmp_path / "a.exr", ["S0.450,0nm", "S0.460,0nm"])
    data = bytearray((tmp_path / "a.exr").read_bytes())
    data[-200:-190] = bytes(10)  # the head of the only chunk
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(CaptureError, match=r"a\.exr: damaged: "):
        open_spectral_file(tmp_path / "a.exr").read()
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("time", [{"expTime": 0.25}, {"exposure": "250 ms"}])
def test_a_window_is_put_where_it_belongs_and_the_rest_is_missing(tmp_path, time):
    inside = (slice(2, 7), slice(3, 11))
    header = head(window=(3, 2, 10, 6)) | time | {"isoSpeed": 200.0, "aperture": 2.5}
    file = open_spectral_file(write(tmp_path / "a.exr", (header, channels(CUBE[inside]))))
    expected = np.full(CUBE.shape, np.nan, np.float32)
    expected[inside] = CUBE[inside]
    rows_and_bands_of(file, expected)
    check_file(file, exposure_s=0.25, gain=2.0, f_number=2.5)


def test_what_is_rendered_beyond_the_picture_is_cut_off(tmp_path):
    beyond = np.random.default_rng(1).random((HEIGHT + 5, WIDTH + 4, 3)).astype(np.float32)
    header = head(window=(-2, -3, WIDTH + 1, HEIGHT + 1))
    file = open_spectral_file(write(tmp_path / "a.exr", (header, channels(beyond))))
    check_file(file, values=beyond[3:-2, 2:-2])
    outside = write(tmp_path / "b.exr", (head(window=(40, 0, 39 + WIDTH, HEIGHT - 1)), channels(CUBE)))
    corners = r"\[\[40, 0\], \[51, 8\]\] lies outside of the picture \[\[0, 0\], \[11, 8\]\]"
    with pytest.raises(CaptureError, match=corners):
        open_spectral_file(outside)


def test_bands_are_found_in_whichever_part_they_are(tmp_path):
    preview = channels(CUBE, "RGB")
    write(tmp_path / "a.exr", (head("rgba"), preview), (head("spectral"), channels(CUBE)))
    file = open_spectral_file(tmp_path / "a.exr")
    check_file(file, nm=[450, 550, 650], values=CUBE)
    assert [part["name"] for part in file.others["parts"]] == ["rgba", "spectral"]
    assert sorted(file.others["other_channels"]) == ["B", "G", "R"]
    check_file(open_spectral_file(tmp_path / "a.exr", ReadOptions(dataset="rgba")), values=CUBE)


def test_bands_of_several_parts_are_joined_each_at_its_own_window(tmp_path):
    parts, expected = [], CUBE.copy()
    for index, name in enumerate(NAMES):
        top = 0 if index else 1
        own = np.ascontiguousarray(CUBE[top:, :, index])
        parts.append((head(f"band{index}", (0, top, WIDTH - 1, HEIGHT - 1)), {name: own}))
    expected[0, :, 0] = np.nan
    check_file(open_spectral_file(write(tmp_path / "a.exr", *parts)), values=expected)


def test_parts_that_are_left_out_are_said(tmp_path):
    same = write(tmp_path / "a.exr", (head("left"), channels(CUBE)), (head("right"), channels(CUBE / 2)))
    check_file(open_spectral_file(same), values=CUBE, warning="1 other parts have the same ones")
    check_file(open_spectral_file(same, ReadOptions(dataset="right")), values=CUBE / 2)
    colours, depth = (head("x"), channels(CUBE, "RGB")), (head("y"), {"Z": CUBE[..., 0].copy()})
    plain = write(tmp_path / "b.exr", colours, depth)
    check_file(open_spectral_file(plain), warning="the file also has the parts y")
