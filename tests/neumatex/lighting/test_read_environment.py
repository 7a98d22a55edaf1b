"""Environment maps from files, and what is refused."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from unmix_plugin.errors import SceneError
from unmix_plugin.formats.exr import write_exr
from unmix_plugin.neumatex.lighting.read_environment import read_environment


def _picture(height=4, width=8):
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


def test_exr_is_read_with_rotation_and_exposure(tmp_path):
    image = _picture()
    environment = read_environment(_exr(tmp_path / "light.exr", image), 20.0, 1.0)
    assert_close(environment.image, torch.from_numpy(image))
    assert (environment.rotation_deg, environment.exposure_stops) == (20.0, 1.0)


def test_hdr_is_read_flat_and_run_length_coded(tmp_path):
    image = _picture(8, 16)
    image[2] = 1.5
    rgbe = _rgbe(image)
    (tmp_path / "flat.hdr").write_bytes(_header(image) + rgbe.tobytes())
    (tmp_path / "runs.hdr").write_bytes(_header(image) + b"".join(_run_length_row(row) for row in rgbe))
    flat, runs = (read_environment(tmp_path / name).image for name in ("flat.hdr", "runs.hdr"))
    assert torch.equal(flat, runs)
    brightest = torch.from_numpy(image).max(dim=-1, keepdim=True).values
    assert bool(((flat - torch.from_numpy(image)).abs() <= brightest / 128).all())


def test_hdr_repeats_pixels_in_the_old_code(tmp_path):
    image = np.full((2, 4, 3), 2.0, np.float32)
    pixel = _rgbe(image)[0, 0].tobytes()
    (tmp_path / "old.hdr").write_bytes(_header(image) + 2 * (pixel + bytes([1, 1, 1, 3])))
    assert_close(read_environment(tmp_path / "old.hdr").image, torch.full((2, 4, 3), 2.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda image: image.__setitem__((1, 2, 0), np.nan),
            "not finite in 1 pixel, first in row 1, column 2",
        ),
        (lambda image: image.__setitem__((0, 3, 1), -0.5), "negative value in 1 pixel,"),
        (lambda image: image.fill(0.0), "black everywhere"),
    ],
)
def test_impossible_values_are_refused(tmp_path, change, message):
    image = _picture()
    change(image)
    with pytest.raises(SceneError, match=message):
        read_environment(_exr(tmp_path / "light.exr", image))


def test_wrong_aspect_channels_and_files_are_refused(tmp_path):
    with pytest.raises(SceneError, match="is 6 x 4 pixels"):
        read_environment(_exr(tmp_path / "square.exr", _picture(4, 6)))
    with pytest.raises(SceneError, match="needs R, G and B"):
        read_environment(write_exr(tmp_path / "depth.exr", {"Z": _picture()[..., 0]}, {}))
    with pytest.raises(SceneError, match="no such environment map"):
        read_environment(tmp_path / "missing.exr")
    (tmp_path / "light.png").write_bytes(b"")
    with pytest.raises(SceneError, match="convert it to one of"):
        read_environment(tmp_path / "light.png")
    for name in ("text.exr", "text.hdr"):
        (tmp_path / name).write_text("no picture")
        with pytest.raises(SceneError, match=r"OpenEXR|Radiance"):
            read_environment(tmp_path / name)


def test_cut_and_turned_hdr_is_refused(tmp_path):
    image = _picture(8, 16)
    (tmp_path / "cut.hdr").write_bytes(_header(image) + _rgbe(image).tobytes()[:-9])
    with pytest.raises(SceneError, match="breaks in row 7 of 8"):
        read_environment(tmp_path / "cut.hdr")
    (tmp_path / "up.hdr").write_bytes(_header(image, order=b"+Y %d +X %d\n") + _rgbe(image).tobytes())
    with pytest.raises(SceneError, match="in the order"):
        read_environment(tmp_path / "up.hdr")
