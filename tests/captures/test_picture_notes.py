"""What a user is told of captures that are pictures for people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.captures.capture_factory import HEIGHT, WIDTH, write_poses
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.process import process_capture
from unmix_plugin.errors import CaptureError

NAMES = ["view_00", "view_01", "view_02", "view_03"]
ORIENTATION = 0x0112


def write_views(root: Path, ground: int, alpha: tuple[str, ...] = (), turned: tuple[str, ...] = ()) -> None:
    """Pictures of a textured square on a noisy grey ground."""
    generator = np.random.default_rng(0)
    (root / "images").mkdir(parents=True)
    for name in NAMES:
        pixels = generator.integers(ground - 9, ground + 1, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        pixels[8:16, 8:20] = generator.integers(40, 120, (8, 12, 3))
        if name in alpha:
            pixels = np.dstack([pixels, np.full((HEIGHT, WIDTH), 255, np.uint8)])
        exif = Image.Exif()
        exif[ORIENTATION] = 6 if name in turned else 1
        Image.fromarray(pixels).save(root / "images" / f"{name}.png", exif=exif)
    write_poses(root / "transforms.json", NAMES)


def notes_of(root: Path, output: Path, wavelengths: str = "610,550,465", **options) -> str:
    """All that is said while the pictures become a scene."""
    told: list[str] = []
    asked = ProcessOptions("nerfstudio", root, output, wavelengths=wavelengths, **options)
    process_capture(asked, told.append, lambda _, views: views)
    return "\n".join(told)


def test_alpha_that_some_views_lack_is_not_dropped_in_silence(tmp_path: Path):
    write_views(tmp_path / "capture", 90, alpha=("view_00", "view_01", "view_03"))
    said = "1 of 4 views has no alpha channel (view_02), so that of the others is not used"
    assert said in notes_of(tmp_path / "capture", tmp_path / "scene")
    assert "alpha channel" not in notes_of(tmp_path / "capture", tmp_path / "asked", mask="none")


def test_wavelengths_from_short_to_long_are_questioned(tmp_path: Path):
    write_views(tmp_path / "capture", 90)
    told = notes_of(tmp_path / "capture", tmp_path / "scene", "465,550,610")
    assert "465 nm is taken for red, 550 nm for green, 610 nm for blue" in told
    assert "give --wavelengths 610,550,465" in told
    assert "taken for red" not in notes_of(tmp_path / "capture", tmp_path / "usual")


def test_turned_pictures_are_read_as_stored_with_a_note(tmp_path: Path):
    write_views(tmp_path / "capture", 90, turned=("view_01", "view_02"))
    told = notes_of(tmp_path / "capture", tmp_path / "scene")
    assert "EXIF's orientation of 2 of 4 pictures is ignored" in told


def test_poses_of_turned_pictures_name_the_orientation(tmp_path: Path):
    write_views(tmp_path / "capture", 90, turned=("view_01",))
    write_poses(tmp_path / "capture" / "transforms.json", NAMES[1:3], width=HEIGHT, height=WIDTH)
    with pytest.raises(CaptureError, match="or store them turned as EXIF's orientation says"):
        notes_of(tmp_path / "capture", tmp_path / "scene")


@pytest.mark.parametrize(("ground", "is_white"), [(254, True), (160, False), (20, False)])
def test_a_white_background_suggests_its_mask(tmp_path: Path, ground: int, is_white: bool):
    write_views(tmp_path / "capture", ground)
    assert ("--mask white leaves it out" in notes_of(tmp_path / "capture", tmp_path / "scene")) == is_white


def test_a_white_background_needs_no_hint_where_a_mask_is_chosen(tmp_path: Path):
    write_views(tmp_path / "capture", 254)
    for mask in ("white", "none"):
        assert "leaves it out" not in notes_of(tmp_path / "capture", tmp_path / mask, mask=mask)
