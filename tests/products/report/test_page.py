import base64
import io

import numpy as np
import pytest
from PIL import Image

from unmix_plugin.products.report.report import _png_url


def decoded(url: str) -> np.ndarray:
    data = url.removeprefix("data:image/png;base64,")
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        return np.asarray(image)


def test_a_picture_holds_its_pixels():
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    np.testing.assert_array_equal(decoded(_png_url(pixels)), pixels)
    np.testing.assert_array_equal(decoded(_png_url(pixels / 255)), pixels)


@pytest.mark.parametrize(("size", "expected"), [((10, 1280), (5, 640)), ((2000, 1), (640, 1))])
def test_a_large_picture_is_shrunk(size, expected):
    assert decoded(_png_url(np.zeros((*size, 3)))).shape[:2] == expected
