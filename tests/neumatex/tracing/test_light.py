"""Environments: looked up, drawn from, built in and read; lamps for pictures of many bands."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.factories.surfaces import generator, unit
from unmix_plugin.errors import SceneError, SpectrumError
from unmix_plugin.formats.exr import write_exr, write_spectral_exr
from unmix_plugin.neumatex.tracing.built_in_lights import NAMES, built_in_environment
from unmix_plugin.neumatex.tracing.environment import Environment, PictureInversion, directions_of_pixels
from unmix_plugin.neumatex.tracing.light_files import of_lamp, read_environment, read_lamp
from unmix_plugin.spectral.bands import Bands


def _uniforms(count):
    return torch.rand(count, 2, generator=generator(), dtype=torch.float64)


def _spotty(rotation=0.0):
    return Environment(torch.rand(16, 32, 3, generator=generator(5)) ** 6, rotation)


@pytest.mark.parametrize(
    "weights", [[[1.0]], [[0, 3.0], [0, 0]], [[1, 1, 1, 1.0]] * 2, [[0.1, 7, 0], [0.2, 2, 2]]]
)
def test_pixels_are_drawn_by_their_weights_and_evenly_within(weights):
    given = torch.tensor(weights)
    axis = (torch.arange(600, dtype=torch.float64) + 0.5) / 600
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1).reshape(-1, 2)
    row, column, down, across = PictureInversion(given.double()).draw(grid)
    drawn = torch.zeros_like(given, dtype=torch.float64)
    drawn.index_put_((row, column), torch.ones_like(down), accumulate=True)
    assert_close(drawn / len(grid), given.double() / given.double().sum(), atol=3e-3, rtol=0)
    assert bool((drawn[given == 0] == 0).all())
    for place in (down, across):
        heaviest = place[(row * given.shape[1] + column) == given.argmax()]
        assert_close(heaviest.mean(), torch.tensor(0.5, dtype=torch.float64), atol=0.01, rtol=0)
        assert_close(heaviest.std(), torch.tensor(12**-0.5, dtype=torch.float64), atol=0.01, rtol=0)


def test_directions_follow_the_stated_convention():
    image = torch.zeros(4, 8, 3)
    image[2, 1] = torch.tensor([1.0, 2.0, 3.0])
    azimuth, polar = 2 * math.pi * (0.5 - (1 + 0.5) / 8), math.pi * (2 + 0.5) / 4

    def seen(turn_deg, **settings):
        angle = azimuth + math.radians(turn_deg)
        flat = math.sin(polar)
        direction = torch.tensor([[flat * math.cos(angle), flat * math.sin(angle), math.cos(polar)]])
        return Environment(image, **settings).radiance(direction)[0]

    assert_close(seen(0), image[2, 1])
    assert_close(seen(0, exposure_stops=1.0), 2 * image[2, 1])
    assert_close(seen(30, rotation_deg=30.0), image[2, 1])
    spotty, centres = _spotty(), directions_of_pixels(16, 32).reshape(-1, 3)
    assert_close(spotty.radiance(centres), spotty.image.reshape(-1, 3), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("rotation", [0.0, -120.0])
def test_draws_have_the_stated_density_which_integrates_to_one(rotation):
    environment = _spotty(rotation)
    directions, density = environment.sample(_uniforms(200_000))
    assert_close(directions.norm(dim=-1), torch.ones(200_000))
    same = torch.isclose(environment.density(directions), density, rtol=1e-4)
    assert same.float().mean() > 0.9999  # some fall on an edge of pixels
    estimate = (directions[:, 0].exp() * (1 + directions[:, 2]) / density).double().mean()
    uniform = unit(torch.randn(400_000, 3, generator=generator()))
    assert 4 * math.pi * float(environment.density(uniform).double().mean()) == pytest.approx(1, abs=0.02)
    expected = 4 * math.pi * (uniform[:, 0].exp() * (1 + uniform[:, 2])).double().mean()
    # The density of dark pixels is small, so single draws weigh much.
    assert_close(estimate, expected, rtol=0.03, atol=0)


@pytest.mark.parametrize("pole", [0, -1])
def test_a_small_light_at_a_pole_of_a_fine_picture_has_its_power(pole):
    height, image = 2048, torch.zeros(2048, 4096, 1)
    image[pole] = 1.0
    environment = Environment(image)
    evenly = torch.quasirandom.SobolEngine(2).draw(1 << 16, dtype=torch.float64)
    directions, density = environment.sample(evenly)
    power = float((environment.radiance(directions)[:, 0] / density).double().mean())
    # The integral of theta where the light is 1, up to half a row from the pole, and falls to 0 in the row after that.
    expected = 2 * math.pi * (math.pi / height) ** 2 * 13 / 24
    assert power == pytest.approx(expected, rel=0.002)
    assert_close(environment.density(directions), density)


def test_a_black_environment_is_drawn_from_uniformly():
    directions, density = Environment(torch.zeros(4, 8, 3)).sample(_uniforms(4000))
    assert_close(density, torch.full((4000,), 1 / (4 * math.pi)))
    assert_close(directions.mean(dim=0), torch.zeros(3), atol=0.04, rtol=0)


@pytest.mark.parametrize("name", NAMES)
def test_built_in_environments_are_seeded_and_well_exposed(name):
    first, again, other = (built_in_environment(name, seed, height=32) for seed in (1, 1, 2))
    assert torch.equal(first.image, again.image)
    assert not torch.equal(first.image, other.image)
    assert bool((first.image >= 0).all())
    assert_close(first.mean_radiance().mean(), torch.tensor(0.8), atol=1e-4, rtol=0)


def _picture(height, width):
    return np.random.default_rng(0).uniform(0.01, 20, (height, width, 3)).astype(np.float32)


def _exr(path, image):
    return write_exr(path, {name: image[..., i] for i, name in enumerate("RGB")}, {})


def _rgbe(image):
    mantissas, exponents = np.frexp(image.max(axis=-1))
    bytes_ = np.empty((*image.shape[:2], 4), np.uint8)
    bytes_[..., :3] = image * (mantissas / image.max(axis=-1) * 256)[..., None]
    bytes_[..., 3] = exponents + 128
    return bytes_


def _header(image, rest=b"FORMAT=32-bit_rle_rgbe\n", order=b"-Y %d +X %d\n"):
    return b"#?RADIANCE\n" + rest + b"\n" + order % image.shape[:2]


def _run_length_row(row):
    coded = bytes([2, 2, len(row) >> 8, len(row) & 255])
    for channel in row.T:
        if (channel == channel[0]).all():
            coded += bytes([128 + len(channel), channel[0]])
        else:
            coded += bytes([len(channel)]) + channel.tobytes()
    return coded


def test_exr_is_read_and_hdr_flat_run_length_coded_and_in_the_old_code(tmp_path):
    image = _picture(8, 16)
    environment = read_environment(_exr(tmp_path / "light.exr", image), 20.0, 1.0)
    assert_close(environment.image, torch.from_numpy(image))
    assert (environment.rotation_deg, environment.exposure_stops) == (20.0, 1.0)
    image[2] = 1.5
    rgbe = _rgbe(image)
    (tmp_path / "flat.hdr").write_bytes(_header(image) + rgbe.tobytes())
    (tmp_path / "runs.hdr").write_bytes(_header(image) + b"".join(_run_length_row(row) for row in rgbe))
    flat, runs = (read_environment(tmp_path / name).image for name in ("flat.hdr", "runs.hdr"))
    assert torch.equal(flat, runs)
    (tmp_path / "crlf.hdr").write_bytes(_header(image).replace(b"\n", b"\r\n") + rgbe.tobytes())
    assert torch.equal(read_environment(tmp_path / "crlf.hdr").image, flat)
    brightest = torch.from_numpy(image).max(dim=-1, keepdim=True).values
    assert bool(((flat - torch.from_numpy(image)).abs() <= brightest / 128).all())
    rgbe[3, 0] = 2, 2, 200, 120  # the mark of a coded row, as a pixel
    (tmp_path / "blue.hdr").write_bytes(_header(image) + rgbe.tobytes())
    blue = read_environment(tmp_path / "blue.hdr").image[3, 0]
    assert (blue * 2.0**16).tolist() == [2.0, 2.0, 200.0]
    old = np.full((2, 4, 3), 2.0, np.float32)
    pixel = _rgbe(old)[0, 0].tobytes()
    (tmp_path / "old.hdr").write_bytes(_header(old) + 2 * (pixel + bytes([1, 1, 1, 3])))
    assert_close(read_environment(tmp_path / "old.hdr").image, torch.from_numpy(old))


def test_impossible_values_wrong_aspect_channels_and_files_are_refused(tmp_path):
    image = _picture(8, 16)
    for name, place, value in (
        ("nan", (1, 2, 0), np.nan),
        ("negative", (0, 3, 1), -0.5),
        ("black", slice(None), 0.0),
    ):
        spoiled = image.copy()
        spoiled[place] = value
        _exr(tmp_path / f"{name}.exr", spoiled)
    _exr(tmp_path / "square.exr", _picture(4, 6))
    write_exr(tmp_path / "depth.exr", {"Z": image[..., 0]}, {})
    (tmp_path / "light.png").write_bytes(b"")
    (tmp_path / "text.exr").write_text("no picture")
    (tmp_path / "text.hdr").write_text("no picture")
    (tmp_path / "cut.hdr").write_bytes(_header(image) + _rgbe(image).tobytes()[:-9])
    (tmp_path / "up.hdr").write_bytes(_header(image, order=b"+Y %d +X %d\n") + _rgbe(image).tobytes())
    for name, said in {
        "nan.exr": "NaN or infinity in 1 pixel, such as .*nan",
        "negative.exr": "negative values, .* in 1 pixel, such as .*-0.5",
        "black.exr": "black everywhere",
        "square.exr": "is 6 x 4 pixels",
        "depth.exr": "needs R, G and B",
        "missing.exr": "no such environment map",
        "light.png": "convert it to one of",
        "text.exr": "OpenEXR",
        "text.hdr": "Radiance",
        "cut.hdr": "breaks in row 7 of 8",
        "up.hdr": "in the order",
    }.items():
        with pytest.raises(SceneError, match=said):
            read_environment(tmp_path / name)


BANDS = Bands.of([450, 550, 650, 750])


def _csv(path, text):
    path.write_text(text)
    return str(path)


def test_a_lamp_is_a_table_or_a_name_with_its_greatest_band_1(tmp_path):
    lamp = _csv(tmp_path / "lamp.csv", "wavelength,power\n400,0\n500,2\n700,6\n800,6\n")
    np.testing.assert_allclose(read_lamp(lamp, BANDS), np.array([1, 3, 5, 6]) / 6)
    assert read_lamp("d65", BANDS).max() == 1
    envi = tmp_path / "lamp.hdr"
    envi.write_text(
        "ENVI\nsamples = 4\nlines = 1\nbands = 1\nheader offset = 0\nfile type = ENVI Spectral Library\n"
        "data type = 4\ninterleave = bsq\nbyte order = 0\nwavelength units = Nanometers\n"
        "spectra names = {lamp}\nwavelength = {450, 550, 650, 750}\n"
    )
    np.array([1, 2, 4, 3], dtype="<f4").tofile(tmp_path / "lamp.sli")
    np.testing.assert_allclose(read_lamp(str(envi), BANDS), [0.25, 0.5, 1, 0.75])


def test_lines_of_a_lamp_between_bands_count_and_its_own_rounded_bands_are_taken_as_they_are(tmp_path):
    lines = "400,1\n579,1\n580,101\n581,1\n800,1\n"
    found = read_lamp(_csv(tmp_path / "lines.csv", f"wavelength,power\n{lines}"), BANDS)
    # A triangle of area 100 nm in a band of 100 nm over 1.
    np.testing.assert_allclose(found, [0.5, 1, 0.5, 0.5])
    table = "wavelength,power\n450.0004,1\n550,4\n650,1\n750,1\n"
    rounded = read_lamp(_csv(tmp_path / "lamp.csv", table), BANDS)
    np.testing.assert_allclose(rounded, [0.25, 1, 0.25, 0.25])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("wavelength,power\n500,1\n800,1\n", "do not reach"),
        ("wavelength,a,b\n400,1,1\n800,1,1\n", "one spectrum; found 2"),
        ("wavelength,power\n400,0\n500,0\n800,1\n", "no power at 450 nm"),
    ],
)
def test_lamps_that_tell_nothing_of_some_band_are_refused(tmp_path, text, expected):
    with pytest.raises(SpectrumError, match=expected):
        read_lamp(_csv(tmp_path / "lamp.csv", text), BANDS)


def test_colours_of_an_environment_get_the_lamps_spectrum_by_their_luminance():
    lamp = torch.tensor([0.1, 0.5, 1.0, 0.2])
    image = torch.rand(4, 8, 3, generator=generator())
    light = of_lamp(Environment(image, 30.0, 1.0), lamp)
    luminance = 0.2126 * image[..., 0] + 0.7152 * image[..., 1] + 0.0722 * image[..., 2]
    assert_close(light.image, luminance[..., None] * lamp)
    assert (light.rotation_deg, light.exposure_stops) == (30.0, 1.0)
    assert_close(light.mean_radiance() / light.mean_radiance().max(), lamp)


def test_a_spectral_environment_is_brought_to_the_bands(tmp_path):
    source = Bands.of([400, 600, 800])
    image = np.ones((4, 8, 1), np.float32) * np.array([1, 2, 6], np.float32)
    path = write_spectral_exr(tmp_path / "light.exr", image, source, None)
    light = read_environment(path, 10.0, bands=BANDS)
    assert_close(light.image[0, 0], torch.tensor([1.25, 1.75, 3.0, 5.0]))
    assert light.rotation_deg == 10.0


def test_colours_beside_wavelengths_light_what_is_in_colours(tmp_path):
    channels = {name: np.full((4, 8), level, np.float32) for level, name in enumerate(["T.500nm", *"RGB"])}
    light = read_environment(write_exr(tmp_path / "light.exr", channels, {}))
    assert_close(light.image[0, 0], torch.tensor([1.0, 2.0, 3.0]))


def test_environments_whose_light_is_not_known_in_every_band_are_refused(tmp_path):
    grey, two = np.ones((4, 8), np.float32), np.ones((4, 8, 2), np.float32)
    colours = write_exr(tmp_path / "rgb.exr", dict.fromkeys("RGB", grey), {})
    short = write_spectral_exr(tmp_path / "short.exr", two, Bands.of([500, 700]), None)
    nameless = write_exr(tmp_path / "two.exr", dict.fromkeys("PQ", grey), {})
    for path, lamp, said in (
        (colours, None, "light's spectrum is not known; give the lamp's"),
        (short, None, "do not match: .* 50 nm below and 50 nm above"),
        (nameless, np.ones(4), "needs R, G and B"),
    ):
        with pytest.raises(SceneError, match=said):
            read_environment(path, bands=BANDS, lamp=lamp)
