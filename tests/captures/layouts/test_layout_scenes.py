"""From the folder of each layout to a scene that loads, with the values and splits that were there."""

import numpy as np
import pytest

from tests.captures.layouts.data_sets import cube, intensity, write_hs, write_nespof, write_real, write_unmix
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.process import process_capture
from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene


def process(layout, root, output, **given) -> Scene:
    options = ProcessOptions(layout, data=root, output_dir=output, **given)
    process_capture(options, lambda _: None, lambda _, views: views)
    return load_scene(output)


def names(scene, indices):
    return [scene.frames[index].name for index in indices]


def test_nespof(tmp_path):
    write_nespof(tmp_path / "ajar")
    scene = process("nespof", tmp_path / "ajar", tmp_path / "scene", scale=2.0)
    assert scene.wavelengths_nm.tolist() == [450.0, 460.0, 470.0]
    assert names(scene, scene.eval_indices) == ["r_0"]
    assert names(scene, scene.train_indices) == ["r_1", "r_2", "r_3", "r_4"]
    index = [frame.name for frame in scene.frames].index("r_3")
    alpha = scene.alpha(index)
    assert alpha is not None
    np.testing.assert_allclose(alpha, np.linspace(0, 1, 35).reshape(5, 7), atol=0.003)
    seen = alpha > 0
    expected = np.stack([intensity(3, wavelength) for wavelength in (450, 460, 470)], axis=-1) / 2.0
    np.testing.assert_allclose(scene.cube(index)[seen], expected[seen], atol=1e-4)


def test_nespof_real(tmp_path):
    write_real(tmp_path / "real", views=("a", "b", "c"))
    scene = process("nespof-real", tmp_path / "real", tmp_path / "scene", scale=2.0)
    expected = np.stack([intensity(1, 450), intensity(1, 460)], axis=-1) / 2.0
    np.testing.assert_allclose(scene.cube(1), expected, atol=1e-4)


def test_unmix_nerf(tmp_path):
    write_unmix(tmp_path / "hotdog")
    scene = process("unmix-nerf", tmp_path / "hotdog", tmp_path / "scene", scale=1.0, mask="none")
    assert names(scene, scene.eval_indices) == ["frame_00003", "frame_00004"]
    np.testing.assert_allclose(scene.cube(1), cube(1), atol=1e-4)
    labels = scene.labels(4)
    assert labels is not None
    assert (labels == 4).all()


def test_hs_nerf_asks_for_wavelengths(tmp_path):
    write_hs(tmp_path / "basil")
    with pytest.raises(CaptureError, match=r"wavelengths of its 4 bands are unknown .*--wavelengths"):
        process("hs-nerf", tmp_path / "basil", tmp_path / "scene")
    scene = process(
        "hs-nerf", tmp_path / "basil", tmp_path / "scene", wavelengths="450,500,550,600", scale=1.0
    )
    assert scene.wavelengths_nm.tolist() == [450.0, 500.0, 550.0, 600.0]
    np.testing.assert_allclose(scene.cube(2), cube(2), atol=1.01 / 255)


def test_nerfstudio_says_what_three_bands_may_stand_for(tmp_path):
    write_unmix(tmp_path / "room", written="val")
    with pytest.raises(CaptureError, match=r"--wavelengths 610,550,465"):
        process("nerfstudio", tmp_path / "room", tmp_path / "scene")
    scene = process("nerfstudio", tmp_path / "room", tmp_path / "scene", wavelengths="610,550,465", scale=1.0)
    assert scene.wavelengths_nm.tolist() == [465.0, 550.0, 610.0]
    from PIL import Image

    pixels = np.asarray(Image.open(tmp_path / "room" / "train" / "frame_00002.png")) / 255
    linear = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(scene.cube(2), linear[..., ::-1], atol=1e-4)
