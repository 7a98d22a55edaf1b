"""Backgrounds that are white or black."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from tests.factories.captures import HEIGHT, WIDTH, make_capture, process
from tests.factories.files import file_of
from unmix_plugin.captures.calibration.calibration import Calibration, Raster
from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.decide import background_rule, choose_mask
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.writing.view_files import (
    UNLABELLED,
    ViewRecipe,
    alpha_picture,
    read_labels,
    read_view_masks,
    write_view,
)
from unmix_plugin.captures.writing.view_files import clean_mask as clean
from unmix_plugin.errors import CaptureError
from unmix_plugin.spectral.colour.srgb import decode_srgb

GENERATOR = np.random.default_rng(0)


@pytest.mark.parametrize(("kind", "level", "foreground"), [("black", 0.03, 0.12), ("white", 0.95, 0.8)])
def test_the_threshold_lies_beyond_the_noise_of_the_border(kind, level: float, foreground: float):
    border = level + 0.01 * GENERATOR.standard_normal((5000, 8)).astype(np.float32)
    rule = background_rule(kind, border, np.ones((500, 8), np.float32))
    assert rule.foreground(border[None]).mean() < 1e-3
    assert rule.foreground(np.full((1, 10, 8), foreground, np.float32)).all()
    with pytest.raises(CaptureError, match=f"--mask {kind}: the border of the views is at 40%"):
        background_rule(kind, np.full((100, 8), 0.4, np.float32), np.ones((9, 8), np.float32))


def test_a_white_background_is_bright_in_every_band():
    rule = background_rule("white", *2 * [np.full((100, 8), 0.98, np.float32)])
    leaf = np.full((1, 1, 8), 0.98, np.float32)
    leaf[..., 3] = 0.4
    assert rule.foreground(leaf).all()


def test_large_holes_and_parts_stay():
    mask = np.zeros((200, 200), bool)
    mask[40:160, 40:160] = True
    mask[80:100, 80:100] = False
    mask[10:20, 10:20] = True
    cleaned, specks, holes = clean(mask)
    np.testing.assert_array_equal(cleaned, mask)
    assert (specks, holes) == (0, 0)


@pytest.mark.parametrize("pixels", [np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 300, np.uint16)])
def test_pictures_that_hold_no_labels_are_refused(tmp_path, pixels):
    Image.fromarray(pixels).save(tmp_path / "labels.png")
    with pytest.raises(CaptureError, match="expected labels of 0 to 255 in one channel"):
        read_labels(CaptureView("a", CUBE, labels=tmp_path / "labels.png"), WHOLE)


def test_pixels_that_are_averaged_keep_the_label_that_all_of_them_have(tmp_path):
    labels = np.arange(6, dtype=np.uint8)[:, None] // 3 + np.zeros((6, 8), np.uint8)
    Image.fromarray(labels).save(tmp_path / "labels.png")
    found = read_labels(CaptureView("a", CUBE, labels=tmp_path / "labels.png"), Raster(0, 1, 3, 3, 2))
    np.testing.assert_array_equal(found, np.repeat([[0], [UNLABELLED], [1]], 3, axis=1))


CUBE = file_of(np.zeros((6, 8, 2), np.uint16))
WHOLE = Raster(0, 0, 6, 8, 1)
LEFT = np.tile(np.arange(8) < 4, (6, 1))


def recipe_of(raster: Raster, bands: int) -> ViewRecipe:
    matrix = np.eye(bands, 3, dtype=np.float32)
    return ViewRecipe(Calibration(raster, np.arange(bands)), 1.0, matrix, use_opacity=True)


@pytest.mark.parametrize("white", [1, 255])
def test_masks_of_ones_are_those_of_255(tmp_path, white):
    Image.fromarray(LEFT.astype(np.uint8) * np.uint8(white)).save(tmp_path / "mask.png")
    view = CaptureView("a", CUBE, mask=tmp_path / "mask.png")
    np.testing.assert_array_equal(read_view_masks(view, WHOLE, use_opacity=True).opacity, LEFT * 255)
    np.testing.assert_array_equal(read_view_masks(view, WHOLE, use_opacity=False).valid, LEFT)


@pytest.mark.parametrize("binning", [1, 2])
def test_colours_of_a_png_are_multiplied_by_its_opacity_before_they_are_averaged(tmp_path, binning):
    """PNG stores colours that are not multiplied by alpha; cubes hold them as seen over black."""
    pixels = np.random.default_rng(3).integers(0, 256, (6, 8, 4), dtype=np.uint8)
    pixels[2, 2], pixels[2, 4], pixels[2, 6] = (255, 255, 255, 128), 255, (200, 100, 50, 0)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    raster = Raster.of(6, 8, None, binning)
    view = CaptureView("a", open_spectral_file(tmp_path / "a.png"))
    write_view(view, recipe_of(raster, 3), tmp_path / "scene")
    linear = decode_srgb(pixels[..., :3] / 255) * (pixels[..., 3:] / 255)
    expected = linear.reshape(raster.height, binning, raster.width, binning, 3).mean(axis=(1, 3))
    written = np.load(tmp_path / "scene/cubes/a.npy") / 65535
    np.testing.assert_allclose(written, expected, atol=2e-4)
    with Image.open(tmp_path / "scene/images/a.png") as picture:
        seen = decode_srgb(np.asarray(picture)[..., :3] / 255)
    np.testing.assert_allclose(seen, expected, atol=0.005)


def test_a_folder_of_pictures_has_the_opacity_of_the_picture_beside_it_if_there_is_one(tmp_path):
    (tmp_path / "a").mkdir()
    for nm in (500, 600):
        Image.fromarray(np.full((6, 8), 255, np.uint8)).save(tmp_path / "a" / f"{nm}nm.png")
    Image.fromarray(np.full((6, 8, 4), 128, np.uint8)).save(tmp_path / "a.png")
    view = CaptureView("a", open_spectral_file(tmp_path / "a"))
    assert alpha_picture(view) is None
    masks = read_view_masks(replace(view, picture=tmp_path / "a.png"), WHOLE, use_opacity=True)
    np.testing.assert_array_equal(masks.opacity, np.full((6, 8), 128))
    assert masks.straight is None


def test_a_scene_without_any_foreground_is_refused(tmp_path):
    made = make_capture(tmp_path / "capture")
    for name in made.reflectance:
        pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
        Image.fromarray(pixels).save(made.root / f"{name}.png")
    with pytest.raises(CaptureError, match=r"no view shows anything but background, by its mask \(files\)"):
        process(made.root, tmp_path / "scene", mask="files")
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize(("first", "share"), [(5, 0.0), (2, 0.5)])
def test_pixels_without_a_measurement_are_no_share_of_the_foreground(tmp_path, first, share):
    values = np.full((4, 5, 2), 0.5, np.float32)
    values[:, 4] = np.nan
    mask = np.tile(np.arange(5) >= first, (4, 1)).astype(np.uint8)
    Image.fromarray(mask).save(tmp_path / "mask.png")
    view = CaptureView("a", file_of(values), mask=tmp_path / "mask.png")
    record = write_view(view, recipe_of(Raster(0, 0, 4, 5, 1), 2), tmp_path / "scene")
    assert (record.missing_pixels, record.matter_share) == (4, share)


def test_views_of_a_rig_are_never_cut_out_of_a_backdrop_by_themselves():
    assert choose_mask("auto", ["a", "b"], without=["a", "b"], is_rig=False) == ("auto", [])
    assert choose_mask("auto", ["a", "b"], without=["a", "b"], is_rig=True) == ("none", [])
