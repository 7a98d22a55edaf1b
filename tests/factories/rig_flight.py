"""A flight with a camera of four lenses like Parrot's Sequoia, written as its files would be.

The ground is the plane z = 0 with a radiance that is known everywhere, so that what a processed pixel must hold follows
from its ray. Lenses look down from different places on the rig and are turned against each other.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.factories.files import present, write_band_file
from unmix_plugin.captures.poses.lens import Lens

WIDTH, HEIGHT = 64, 48
PX_A_MM = 20.0
"""Pixels a millimetre of the focal plane."""
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0])
VIGNETTING = {(0, 0): 0.55, (1, 0): 1.5, (2, 0): -1.5, (0, 1): 0.4, (0, 2): -0.4}
"""Coefficient of x^n y^m; 1.025 at the centre."""
EXIF = {"FNumber": 2.2, "ISOSpeedRatings": 100}
EXIF |= {"FocalPlaneXResolution": PX_A_MM, "FocalPlaneYResolution": PX_A_MM}


@dataclass(frozen=True)
class LensOfRig:
    """One lens: its band, how it is turned (degrees) and where it is on the rig (m), and its calibration."""

    ending: str
    name: str
    centre_nm: int
    width_nm: int
    angles_deg: tuple[float, float, float]
    place: tuple[float, float, float]
    sensor_model: tuple[float, float, float]
    exposure_s: float
    focal_mm: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


NIR_BENDS = (-0.1, 0.05, 0.0, 0.001, -0.002)
LENSES = (
    LensOfRig("GRE", "Green", 550, 40, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (5.2e5, 2100.0, 300.0), 0.004, 3.0),
    LensOfRig("RED", "Red", 660, 40, (1.5, -2.0, 0.7), (0.03, 0.0, 0.0), (4.1e5, 2000.0, 100.0), 0.006, 3.1),
    LensOfRig("REG", "RedEdge", 735, 10, (-1, 0.5, -1.2), (0.0, 0.02, 0.0), (3.3e5, 1900, 200), 0.008, 2.9),
    LensOfRig("NIR", "NIR", 790, 40, (0.4, 1.1, 2), (0.03, 0.02, 0), (4.8e5, 2050, 400), 0.005, 3, NIR_BENDS),
)


def rotation(angles_deg: tuple[float, float, float]) -> np.ndarray:
    """Rx Ry Rz: from the axes of the lens to those of the reference lens (+x right, +y down, +z forward)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("XYZ", angles_deg, degrees=True).as_matrix()


def rig_pose(index: int) -> np.ndarray:
    """Camera to world of the reference lens (OpenGL), looking down from 4 m while it flies along."""
    pose = np.eye(4)
    turn = 0.1 * index
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:3, 3] = (0.8 * index, 0.1 * index, 4.0)
    return pose


def lens_pose(index: int, lens: LensOfRig, *, at_its_place: bool = True) -> np.ndarray:
    """Camera to world of a lens (OpenGL)."""
    offset = np.eye(4)
    offset[:3, :3] = OPENCV_TO_OPENGL @ rotation(lens.angles_deg) @ OPENCV_TO_OPENGL
    offset[:3, 3] = lens.place if at_its_place else 0.0
    return rig_pose(index) @ offset


def radiance(x: np.ndarray, y: np.ndarray, lens: LensOfRig) -> np.ndarray:
    """Of the ground, in the unit of the camera: smooth, different in every band."""
    level = {"GRE": 0.25, "RED": 0.15, "REG": 0.45, "NIR": 0.6}[lens.ending]
    return level * (1.0 + 0.3 * np.sin(0.9 * x + 0.2) * np.cos(0.7 * y))


def rays(lens: LensOfRig) -> np.ndarray:
    """Directions in the axes of OpenGL of all pixel centres."""
    focal, (k1, k2, k3, p1, p2) = lens.focal_mm * PX_A_MM, lens.distortion
    center = (WIDTH / 2 + 0.7, HEIGHT / 2 - 0.4)
    own = Lens(WIDTH, HEIGHT, (focal, focal), center, (k1, k2, p1, p2), (k3, 0.0))
    x, y = present(own.ideal_of(own.file_pixels().reshape(-1, 2))).T
    return np.stack([x, -y, -np.ones_like(x)], axis=-1).reshape(HEIGHT, WIDTH, 3)


def image(index: int, lens: LensOfRig) -> np.ndarray:
    """Radiance at every pixel of a lens."""
    pose = lens_pose(index, lens)
    directions = rays(lens) @ pose[:3, :3].T
    distance = -pose[2, 3] / directions[..., 2]
    hit = pose[:3, 3] + distance[..., None] * directions
    return radiance(hit[..., 0], hit[..., 1], lens)


def stored(light: np.ndarray, lens: LensOfRig) -> np.ndarray:
    """What the detector writes: the inverse of the formula of Parrot's application note."""
    a, b, c = lens.sensor_model
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    vignetting = sum(k * (x / WIDTH) ** n * (y / HEIGHT) ** m for (n, m), k in VIGNETTING.items())
    gain = (a * lens.exposure_s * EXIF["ISOSpeedRatings"] + c) / EXIF["FNumber"] ** 2
    return np.rint(light * vignetting * gain + b)


def tags(index: int, lens: LensOfRig) -> dict[str, str | list[str]]:
    a, b, c = lens.sensor_model
    return {
        "Camera:BandName": lens.name,
        "Camera:CentralWavelength": str(lens.centre_nm),
        "Camera:WavelengthFWHM": str(lens.width_nm),
        "Camera:CaptureUUID": f"{index:032X}",
        "Camera:RigCameraIndex": str(LENSES.index(lens)),
        "Camera:RigRelatives": ", ".join(map(str, lens.angles_deg)),
        "Camera:SensorModel": f"{a},{b},{c}",
        "Camera:VignettingPolynomial2DName": ",".join(f"{n},{m}" for n, m in VIGNETTING),
        "Camera:VignettingPolynomial2D": ",".join(map(str, VIGNETTING.values())),
        "Camera:ModelType": "perspective",
        "Camera:PerspectiveFocalLength": str(lens.focal_mm),
        "Camera:PrincipalPoint": f"{(WIDTH / 2 + 0.2) / PX_A_MM},{(HEIGHT / 2 - 0.9) / PX_A_MM}",
        "Camera:PerspectiveDistortion": ",".join(map(str, lens.distortion)),
    }


def file_name(index: int, lens: LensOfRig) -> str:
    return f"IMG_170101_1010{index:02d}_{index:04d}_{lens.ending}.TIF"


def write_flight(root: Path, shots: int = 10) -> None:
    """Files of all lenses; EXIF says that they are turned, which must be ignored."""
    for index in range(shots):
        for lens in LENSES:
            exif, counts = EXIF | {"ExposureTime": lens.exposure_s}, stored(image(index, lens), lens)
            write_band_file(root / file_name(index, lens), counts, tags(index, lens), exif, orientation=3)


PANEL_LIGHT = {"GRE": 0.5, "RED": 0.4, "REG": 0.7, "NIR": 0.62}
"""Radiance of a grey panel that fills the images of one shot."""


def write_panel(root: Path) -> str:
    """Files of a shot that shows the panel, before the flight; gives its name."""
    for lens in LENSES:
        light = np.full((HEIGHT, WIDTH), PANEL_LIGHT[lens.ending])
        path = root / f"IMG_170101_100000_9999_{lens.ending}.TIF"
        write_band_file(path, stored(light, lens), tags(9999, lens), EXIF | {"ExposureTime": lens.exposure_s})
    return "IMG_170101_100000_9999"


def write_poses(path: Path, lenses: tuple[LensOfRig, ...] = LENSES[:1], shots: int = 10) -> None:
    """True poses of some lenses, with their lens, as nerfstudio writes them."""
    frames = [
        {"file_path": f"images/{file_name(index, lens)}", "transform_matrix": lens_pose(index, lens).tolist()}
        for index in range(shots)
        for lens in lenses
    ]
    path.write_text(json.dumps({"frames": frames}))
