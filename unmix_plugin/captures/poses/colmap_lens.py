"""Camera models of COLMAP as our lens: exactly where they are of its kind, otherwise the nearest one."""

from __future__ import annotations

from unmix_plugin.captures.poses.lens_fit import (
    Points,
    Project,
    fit_lens,
    project_fisheye,
    project_opencv,
)
from unmix_plugin.captures.poses.pose_set import Lens
from unmix_plugin.errors import CaptureError

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}
"""Name and number of parameters by COLMAP's number."""
PARAMETER_COUNTS = dict(MODELS.values())
_ONE_FOCAL = {
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "SIMPLE_FISHEYE",
}
_FISHEYES = {"OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"}
_EXACT = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"}


def colmap_lens(
    model: str, width: int, height: int, parameters: tuple[float, ...], where: str
) -> tuple[Lens, str | None]:
    """Our lens for a camera of COLMAP, and a note if it is not exactly the same.

    Raises:
        CaptureError: the model can't be represented, or focal length or centre make no sense.
    """
    if model not in _EXACT | _FISHEYES | {"FULL_OPENCV"}:
        known = ", ".join(sorted(_EXACT | _FISHEYES | {"FULL_OPENCV"}))
        raise CaptureError(
            f"{where}: the camera model {model} is not supported; expected one of {known}: run COLMAP's "
            "image_undistorter and give its model and images"
        )
    single = model in _ONE_FOCAL
    focal = (parameters[0], parameters[0]) if single else (parameters[0], parameters[1])
    rest = parameters[1:] if single else parameters[2:]
    center, terms = (rest[0], rest[1]), rest[2:]
    if min(focal) <= 0:
        raise CaptureError(
            f"{where}: a camera has the focal length {min(focal):g}; expected pixels above 0: run COLMAP again"
        )
    if model in _EXACT:
        k1, k2, p1, p2 = (*terms, *([0.0] * (4 - len(terms))))
        return Lens(width, height, focal, center, (k1, k2, p1, p2)), None
    start = Lens(width, height, focal, center)
    if model == "FULL_OPENCV":
        if not any(terms[5:]):
            k1, k2, p1, p2, k3 = terms[:5]
            return Lens(width, height, focal, center, (k1, k2, p1, p2), (k3, 0.0)), None
        return fit_lens(_full_opencv(focal, center, terms), start, model, where)
    return fit_lens(lambda ideal: project_fisheye(ideal, focal, center, terms), start, model, where)


def _full_opencv(
    focal: tuple[float, float], center: tuple[float, float], terms: tuple[float, ...]
) -> Project:
    k1, k2, p1, p2, k3, *below = terms

    def project(ideal: Points) -> Points:
        squared = (ideal**2).sum(axis=1, keepdims=True)
        origin = (0.0, 0.0)
        bent = project_opencv(ideal, (1.0, 1.0), origin, (k1, k2, k3))
        slanted = project_opencv(ideal, (1.0, 1.0), origin, (), (p1, p2)) - ideal
        divisor = 1.0 + sum(k * squared ** (power + 1) for power, k in enumerate(below))
        return (bent / divisor + slanted) * focal + center

    return project
