"""The lens in the tags against OpenCV's and Pix4D's formulas, written out point by point."""

import math
from pathlib import Path

import numpy as np
import pytest

from unmix_plugin.captures.layouts.rig import lens_of
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

WIDTH, HEIGHT = 1280, 960
EXIF = {"FocalPlaneXResolution": 266.667, "FocalPlaneYResolution": 266.667, "FocalPlaneResolutionUnit": 4}
PERSPECTIVE = {
    "Camera:ModelType": "perspective",
    "Camera:PrincipalPoint": "2.35,1.8",
    "Camera:PerspectiveFocalLength": "1449.36",
    "Camera:PerspectiveDistortion": ["-0.097", "0.14", "-0.023", "0.0003", "0.0007"],
}
FISHEYE = {
    "Camera:ModelType": "fisheye",
    "Camera:PrincipalPoint": "2.42299,1.850154",
    "Camera:FisheyeAffineMatrix": "1640.0,1.5,-0.5,1638.0",
    "Camera:FisheyePolynomial": "0,1,-0.025,0.15",
}
DJI = {
    "drone-dji:CalibratedOpticalCenterX": "640.0",
    "drone-dji:CalibratedOpticalCenterY": "480.0",
    "drone-dji:DewarpData": "2022-06-08;2200.5,2199.5,-4.25,7.5,0.008,-0.042,-0.0004,0.0002,-0.06",
}


def file_with(xmp, exif=EXIF) -> SpectralFile:
    metadata = {"xmp": xmp, "exif": exif}
    return SpectralFile(
        Path("a.tif"), "tiff", (HEIGHT, WIDTH, 1), np.dtype("u2"), lambda *_: np.zeros(0), metadata=metadata
    )


def project(lens: Lens, x: float, y: float) -> tuple[float, float]:
    """Through the lens that we keep, pixel centres at 0.5."""
    (k1, k2, k3, k4), (p1, p2) = lens.radial, lens.tangential
    square = x * x + y * y
    factor = 1 + k1 * square + k2 * square**2 + k3 * square**3 + k4 * square**4
    bent_x = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent_y = y * factor + 2 * p2 * x * y + p1 * (square + 2 * y * y)
    return lens.focal_px[0] * bent_x + lens.center_px[0], lens.focal_px[1] * bent_y + lens.center_px[1]


def worst_px(lens: Lens, expected) -> float:
    """Greatest distance over directions that fall on the image."""
    worst = 0.0
    for x in np.linspace(-0.8, 0.8, 161):
        for y in np.linspace(-0.65, 0.65, 131):
            u, v = expected(x, y)
            if 0 <= u <= WIDTH and 0 <= v <= HEIGHT:
                worst = max(worst, math.dist(project(lens, x, y), (u, v)))
    return worst


def perspective_by_hand(x, y, focal=1449.36):
    square = x * x + y * y
    factor = 1 - 0.097 * square + 0.14 * square**2 - 0.023 * square**3
    bent_x = x * factor + 2 * 0.0003 * x * y + 0.0007 * (square + 2 * x * x)
    bent_y = y * factor + 2 * 0.0007 * x * y + 0.0003 * (square + 2 * y * y)
    return focal * bent_x + 2.35 * 266.667 + 0.5, focal * bent_y + 1.8 * 266.667 + 0.5


def test_the_third_radial_term_is_kept():
    lens, notes = lens_of(file_with(PERSPECTIVE))
    assert lens is not None
    assert worst_px(lens, perspective_by_hand) < 1e-6
    assert notes == ()


def test_without_a_third_term_nothing_is_fitted():
    tags = PERSPECTIVE | {"Camera:PerspectiveDistortion": ["-0.097", "0.14", "0", "0.0003", "0.0007"]}
    lens, notes = lens_of(file_with(tags))
    assert lens is not None
    assert lens.distortion == (-0.097, 0.14, 0.0003, 0.0007)
    assert lens.focal_px == (1449.36, 1449.36)
    assert lens.center_px == pytest.approx((2.35 * 266.667 + 0.5, 1.8 * 266.667 + 0.5))
    assert notes == ()


@pytest.mark.parametrize("unit", [{"Camera:PerspectiveFocalLengthUnits": "mm"}, {}])
def test_a_focal_length_in_millimetres_is_told_by_its_unit_or_size(unit):
    tags = PERSPECTIVE | {"Camera:PerspectiveFocalLength": "5.435"} | unit
    lens, _ = lens_of(file_with(tags))
    assert lens is not None
    assert worst_px(lens, lambda x, y: perspective_by_hand(x, y, 5.435 * 266.667)) < 0.1


@pytest.mark.parametrize(("unit", "resolution"), [(2, 266.667 * 25.4), (3, 2666.67), (4, 266.667)])
def test_the_unit_of_the_focal_plane_counts(unit, resolution):
    exif = {f"FocalPlane{axis}Resolution": resolution for axis in "XY"} | {"FocalPlaneResolutionUnit": unit}
    lens, _ = lens_of(file_with(PERSPECTIVE, exif))
    assert lens is not None
    assert worst_px(lens, perspective_by_hand) < 0.1


def fisheye_by_hand(x, y):
    radius = math.hypot(x, y)
    theta = 2 / math.pi * math.atan(radius)
    bent = theta - 0.025 * theta**2 + 0.15 * theta**3
    across, down = (bent / radius * x, bent / radius * y) if radius else (0.0, 0.0)
    return (
        1640.0 * across + 1.5 * down + 2.42299 * 266.667 + 0.5,
        -0.5 * across + 1638.0 * down + 1.850154 * 266.667 + 0.5,
    )


def test_a_fisheye_becomes_the_nearest_lens_and_the_distance_is_said():
    lens, notes = lens_of(file_with(FISHEYE))
    assert lens is not None
    worst = worst_px(lens, fisheye_by_hand)
    assert worst < 4.0
    said = float(next(note for note in notes if "fisheye" in note).split("at most ")[1].split()[0])
    assert said == pytest.approx(worst, rel=0.3)


def test_the_lens_of_dji_counts_from_its_optical_centre():
    lens, _ = lens_of(file_with(DJI, {}))
    assert lens is not None

    def by_hand(x, y):
        square = x * x + y * y
        factor = 1 + 0.008 * square - 0.042 * square**2 - 0.06 * square**3
        bent_x = x * factor - 2 * 0.0004 * x * y + 0.0002 * (square + 2 * x * x)
        bent_y = y * factor + 2 * 0.0002 * x * y - 0.0004 * (square + 2 * y * y)
        return 2200.5 * bent_x + 640.0 - 4.25 + 0.5, 2199.5 * bent_y + 480.0 + 7.5 + 0.5

    assert worst_px(lens, by_hand) < 0.1


@pytest.mark.parametrize(
    ("tags", "exif"),
    [
        ({}, EXIF),
        (PERSPECTIVE, {}),
        (PERSPECTIVE | {"Camera:PerspectiveFocalLength": "0"}, EXIF),
        (FISHEYE | {"Camera:FisheyeAffineMatrix": "1640.0"}, EXIF),
        (DJI | {"drone-dji:DewarpData": "2022-06-08;1,2"}, EXIF),
        (PERSPECTIVE | {"Camera:PrincipalPoint": "1e999,1", "Camera:PerspectiveDistortion": ""}, EXIF),
        (PERSPECTIVE, {"FocalPlaneXResolution": "many"}),
    ],
)
def test_without_the_tags_there_is_no_lens(tags, exif):
    lens, notes = lens_of(file_with(tags, exif))
    assert lens is None
    assert "no lens in the file's tags" in notes[0]


def test_a_lens_that_folds_the_image_is_refused():
    tags = PERSPECTIVE | {"Camera:PerspectiveDistortion": ["-3", "0", "0.5", "0", "0"]}
    with pytest.raises(CaptureError, match=r"a.tif, lens in the XMP"):
        lens_of(file_with(tags))
