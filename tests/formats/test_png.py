"""PNG pictures, read back with imageio and Pillow."""

import imageio.v3 as iio
import numpy as np
from PIL import Image

from unmix_plugin.formats.files import indexed_png_bytes, rgba_png_bytes


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
