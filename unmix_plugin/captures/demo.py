"""The demo scene as an instrument would have written it: raw counts, white, dark, and no poses; as views around a
table, or as scans of a camera that moves on a linear stage past it or on an arm around it.

A folder with one ENVI cube a view (`view_000.hdr` and `.raw`), `white` and `dark` the same, `poses-true.json` in the
form of transforms.json, and `truth/` with labels and reflectances, for whoever compares. Writing it twice gives the
same bytes. On request a board of printed markers lies around the plate, and the camera sees more of the table.

Beside scans stand two tables of the same poses: `stages.csv` with a row a scan and what its stage did, and
`poses-true.csv` with the pose of each line.

The instrument is a line camera. One row of an image is exposed at a time, so that every column and band of the detector
has a sensitivity and a dark current of its own, and what a column gets wrong it gets wrong in every row.

Notation: `B` bands, `W` columns, `h` rows; `N` scans of `H` lines. Light is relative to a white matt panel, 1.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt16

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.engine.runs.replacing import move_files
from unmix_plugin.engine.tables import csv_bytes
from unmix_plugin.errors import ConfigError, install_hint
from unmix_plugin.formats.envi import UINT16, beside, cube_entries, header_bytes, wavelength_entries
from unmix_plugin.scenes.demo.scene import (
    SIZE_BOUNDS,
    VIEWS_BOUNDS,
    Place,
    check_bounds,
    demo_cameras,
    label_image,
    lens_entries,
    reflected,
    staging_for,
    transform_matrix,
)
from unmix_plugin.scenes.demo.shading import (
    MATERIALS,
    Surface,
    Thing,
    band_centers_nm,
    lamp_power,
    reflectances,
    render_view,
    speckled_things,
)
from unmix_plugin.scenes.demo.shapes import PlacedPrimitive
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

RAW_SIZE, RAW_BANDS, RAW_VIEWS = 400, 31, 40
"""Defaults: as many views and pixels as structure from motion needs."""
RAW_LAMP = "A"
"""The lamp of the laboratory: a halogen lamp, which has little blue."""
_RAW_BANDS_BOUNDS = (10, 512)
"""Among fewer, a noisy band can't be told from the others."""
_REFERENCE_LINES = 100
"""Rows of the white and of the dark."""
FULL_WELL = 100_000.0
"""Electrons that a pixel of the detector can hold."""
_ELECTRONS_PER_COUNT = FULL_WELL / 64_000
READ_NOISE = 12.0
"""Electrons, standard deviation."""
WHITE_SHARE = 0.95
"""Share of the full well that the white panel fills in the best band and column: brighter highlights saturate."""
_DARK_COUNTS = 900.0
_DARK_SPREAD = 120.0
"""Standard deviation of the dark counts of columns."""
_GAIN_SPREAD = 0.03
"""Standard deviation of the columns' sensitivities, as a share."""
_VIGNETTING = 0.3
"""Light that the lens loses at the ends of the line, as a share."""
_BAD_NOISE = 0.5
"""Noise of a noisy band as a share of the full well."""
MARKER_FAMILY, MARKER_SIZE = "DICT_4X4_50", 0.42
"""Of the printed board: OpenCV's name, and the side of a marker in scene units, which pass for metres."""
_BOARD_REACH, _BOARD_STEP, _BOARD_TOP = 1.96, 0.553, -0.12
"""Half the side of the board, the distance between its markers, and the height of the plate's underside."""
_BOARD_ANGLE_DEG = 52.0
"""Between the edges of a picture that shows most of the board."""
POSES = "poses-true.json"
Backdrop = Callable[[Float[np.ndarray, "R 3"], Float[np.ndarray, "R 3"]], Float[np.ndarray, " R"]]
"""From origins and directions of rays to the light that a grey backdrop sends along them."""


@dataclass(frozen=True)
class PosesFile:
    """The file of a capture that says where its cameras were, without which it is none."""

    name: str
    write: Callable[[Path, Cameras], None]
    """Into a folder; files beside it, too, perhaps."""


def make_demo_capture(
    directory: Path,
    size: int = RAW_SIZE,
    bands: int = RAW_BANDS,
    views: int = RAW_VIEWS,
    overwrite: bool = False,
    illuminant: str | Path = RAW_LAMP,
    place: Place | None = None,
    backdrop: Backdrop | None = None,
    poses: PosesFile | None = None,
    follow: Callable[[str, Sequence[int]], Iterable[int]] = lambda _, items: items,
) -> None:
    """Write the demo capture, in place of an older one. It is built beside the folder and moved in when complete.

    Args:
        directory: Made if absent, parents too.
        overwrite: Whether a folder with something in it is accepted; files that are not ours stay.
        illuminant: The lamp: the name of a known light, or a CSV file (wavelength,power).
        place: What there is to see, and from where; None is the table with speckles on every surface.
        backdrop: What is behind all things; None is nothing.
        poses: Where the cameras were; None is `poses-true.json`, a pose a view.
        follow: Gives the items, while it shows how many are done.
    Raises:
        ConfigError: a number out of bounds; a folder with something in it, or no folder at all.
        SpectrumError: an unknown light, or one that is not known at all bands.
        SceneError: the folder can't be written, or the disk is full.
    """
    from PIL import Image

    place = place or Place(speckled_things(), demo_cameras)
    bounds = {"size": (size, SIZE_BOUNDS), "bands": (bands, _RAW_BANDS_BOUNDS)}
    check_bounds("a demo capture", bounds | {"views": (views, VIEWS_BOUNDS)})
    sampling = Bands.of(band_centers_nm(bands))
    lamp = lamp_power(sampling.centers_nm, illuminant)
    cameras, spectra = place.cameras(size, views), reflectances(sampling.centers_nm)
    poses = poses or PosesFile(POSES, _write_frame_poses)
    with staging_for(directory, "the demo capture", overwrite, poses.name) as staging:
        truth = staging / "truth"
        truth.mkdir()
        write_spectra_csv(truth / "endmembers.csv", SpectraTable(sampling, MATERIALS, spectra))
        write_spectra_csv(truth / "illuminant.csv", SpectraTable(sampling, ("power",), lamp[None]))
        camera, generator = _demo_line_camera(size, sampling.centers_nm, lamp), np.random.default_rng(1)

        def write(name: str, light: Float32[np.ndarray, "h W B"], what: str) -> None:
            """NAME.hdr and NAME.raw, band-interleaved by line; the header marks some of the bad bands."""
            counts = camera.expose(light, generator)
            entries = cube_entries(
                "ENVI Standard", f"{what}, raw counts", size, len(counts), bands, "bil", UINT16
            )
            entries |= wavelength_entries(sampling)
            entries["bbl"] = [str(int(band not in camera.marked)) for band in range(bands)]
            beside(staging / name, ".raw").write_bytes(counts.astype("<u2").transpose(0, 2, 1).tobytes())
            beside(staging / name, ".hdr").write_bytes(header_bytes(entries))

        for name, level in (("dark", 0.0), ("white", 1.0)):
            write(name, np.full((_REFERENCE_LINES, size, bands), level, np.float32), f"{name} reference")
        for index in follow("rendering views", range(views)):
            view, name = render_view(cameras, index, things=place.things), f"view_{index:03d}"
            light = reflected(view, spectra)
            if backdrop is not None:
                rays = cameras.image_rays(index)
                behind = backdrop(rays.origins.double().numpy(), rays.directions.double().numpy())
                light += ((1 - view.alpha) * behind.reshape(view.alpha.shape))[..., None].astype(np.float32)
            write(name, light, "a view of the demo scene")
            Image.fromarray(label_image(view)).save(truth / f"{name}.png")
        poses.write(staging, cameras)
        move_files(staging, directory, poses.name)


def _write_frame_poses(folder: Path, cameras: Cameras) -> None:
    frames = [
        {"file_path": f"view_{index:03d}.hdr", "transform_matrix": transform_matrix(cameras, index)}
        for index in range(len(cameras))
    ]
    content = json.dumps(lens_entries(cameras) | {"frames": frames}, indent=1) + "\n"
    (folder / POSES).write_text(content, encoding="utf-8")


def marked_place(things: Sequence[Thing] | None = None) -> Place:
    """The table (or other things) with a board of markers around the plate, as seen by a lens that is wide enough.
    Raises ConfigError: OpenCV, which knows the markers, is not installed."""
    placement = PlacedPrimitive("box", (0.0, 0.0, _BOARD_TOP - 0.02), (_BOARD_REACH, _BOARD_REACH, 0.02))
    try:
        import cv2
    except ImportError as error:
        raise ConfigError(f"OpenCV, which prints markers, is not installed: {install_hint('sfm')}") from error
    # Where the board is printed: 24 markers on a square of 7 a side, upright towards +y.
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_FAMILY))
    cells = dictionary.markerSize + 2  # with the black border
    steps = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if max(abs(i), abs(j)) == 3]
    middles = _BOARD_STEP * np.array(steps)
    printed_as = [cv2.aruco.generateImageMarker(dictionary, index, cells) for index in range(len(steps))]
    black = np.stack(printed_as) < 128

    def print_of(local_points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
        points = local_points[:, :2] * _BOARD_REACH
        nearest = np.abs(points[:, None] - middles).max(axis=2).argmin(axis=1)
        across, up = ((points - middles[nearest]) / MARKER_SIZE + 0.5).T
        column, row = np.floor(across * cells).astype(int), np.floor((1.0 - up) * cells).astype(int)
        inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < cells)
        printed = black[nearest, row.clip(0, cells - 1), column.clip(0, cells - 1)]
        return (printed & inside & (local_points[:, 2] > 0.999)).astype(local_points.dtype)

    board = Thing(placement, Surface("white", "purple", print_of))
    cameras = partial(demo_cameras, angle_deg=_BOARD_ANGLE_DEG)
    return Place((*(things or speckled_things()), board), cameras)


@dataclass(frozen=True)
class _LineCamera:
    """One detector behind one lens, with three bands that measure nothing usable."""

    white_electrons: Float32[np.ndarray, "W B"]
    """What the white panel gives."""
    dark_counts: Float32[np.ndarray, "W B"]

    @property
    def bad(self) -> tuple[int, int, int]:
        """The first band is noisy, one is dead after a third of the bands, one noisy after two thirds."""
        bands = self.white_electrons.shape[1]
        return 0, bands // 3, 2 * bands // 3

    @property
    def marked(self) -> tuple[int, int]:
        """Bands that the header marks as bad: the last one is left to be found."""
        return self.bad[:2]

    def expose(
        self, light: Float32[np.ndarray, "h W B"], generator: np.random.Generator
    ) -> UInt16[np.ndarray, "h W B"]:
        """Counts for light, with shot noise and read noise; 65535 where the pixel is full."""
        noisy, dead, noisy_unmarked = self.bad
        electrons = light * self.white_electrons
        noise = generator.standard_normal(light.shape, dtype=np.float32)
        electrons += noise * np.sqrt(electrons + np.float32(READ_NOISE**2))
        for band in (noisy, noisy_unmarked):
            extra = generator.standard_normal(light.shape[:2], dtype=np.float32)
            electrons[..., band] += np.float32(_BAD_NOISE * FULL_WELL) * extra
        counts = self.dark_counts + electrons / np.float32(_ELECTRONS_PER_COUNT)
        counts[..., dead] = 0
        return counts.round().clip(0, np.iinfo(np.uint16).max).astype(np.uint16)


def _demo_line_camera(
    width: int, wavelengths_nm: Float[np.ndarray, " B"], lamp: Float[np.ndarray, " B"]
) -> _LineCamera:
    """The demo's line camera, of so many columns, under a lamp of this power in each band, in any unit."""
    generator = np.random.default_rng(8)
    bands = len(wavelengths_nm)
    # Silicon behind a grating: most sensitive in the green, a third of that at 400 nm.
    sensitivity = np.exp(-(((wavelengths_nm - 560) / 150) ** 2))
    across = np.linspace(-1, 1, width)[:, None]
    columns = (1 - _VIGNETTING * across**2) * (1 + _GAIN_SPREAD * generator.standard_normal((width, bands)))
    light = columns * sensitivity * lamp
    # Columns are read through two amplifiers in turn, whose offsets differ.
    dark = _DARK_COUNTS + _DARK_SPREAD * (
        generator.standard_normal((width, 1)) + 0.3 * generator.standard_normal((width, bands))
    )
    dark[1::2] += _DARK_SPREAD
    white = WHITE_SHARE * FULL_WELL * light / light.max()
    return _LineCamera(white.astype(np.float32), dark.clip(0).astype(np.float32))


# Scans of a camera that moves.

STAGES, LINE_POSES = "stages.csv", "poses-true.csv"
LINE_SIZE, LINE_SCANS = 160, 24
"""Defaults: lines and columns of a scan, and scans."""
FIELD_OF_VIEW_DEG = 38.0
"""Of the line."""
_SWEEP = 2.4
"""How far the linear stage moves the camera, scene units, which pass for metres."""
_ARM_EVERY = 4
"""Which scan of so many is one from the arm, the last."""
_AXIS = (0.0, 0.0, 1.0)


def is_from_arm(index: int) -> bool:
    """Whether a scan goes all around the table, from above; others pass it."""
    return index % _ARM_EVERY == _ARM_EVERY - 1


def scanning_cameras(size: int, scans: int) -> Cameras:
    """Line cameras that begin on the dome of the demo's cameras: those of the linear stage go down their own y axis by
    2.4 units, those of the arm once around the z axis, counter clockwise seen from above."""
    still = demo_cameras(size, scans, FIELD_OF_VIEW_DEG)
    poses = still.camera_to_world.double().numpy()
    found = []
    for index, pose in enumerate(poses):
        if not is_from_arm(index):
            shares = 0.5 - (np.arange(size) + 0.5) / size
            lines = np.repeat(pose[None], size, axis=0)
            lines[:, :, 3] += _SWEEP * shares[:, None] * pose[:, 1]
        else:
            # The line stands upright: the camera, turned by a quarter, has its y axis against the way it goes.
            upright = np.column_stack([pose[:, 1], -pose[:, 0], pose[:, 2], pose[:, 3]])
            angles = 2 * np.pi * np.arange(size) / size
            cosine, sine, zero = np.cos(angles), np.sin(angles), np.zeros(size)
            turns = np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1], axis=1)
            lines = turns.reshape(size, 3, 3) @ upright
        found.append(lines)
    stacked = torch.from_numpy(np.concatenate(found)).float()
    heights = (torch.arange(size) + 0.5).repeat(scans)
    return Cameras(
        still.camera_to_world,
        still.focal_px,
        still.center_px,
        still.distortion,
        size,
        size,
        key_poses=KeyPoses(stacked, heights, (size,) * scans),
    )


def _write_line_poses(folder: Path, cameras: Cameras) -> None:
    """Write both tables."""
    from scipy.spatial.transform import Rotation

    assert cameras.key_poses is not None
    axes = "xyz"
    of_lines = [["scan", "line", *(f"{axis} (m)" for axis in axes), "qw", "qx", "qy", "qz"]]
    heads = [f"{name}_{axis}" for name in ("look", "direction", "axis") for axis in axes]
    heads += [f"centre_{axis} (m)" for axis in axes]
    of_stages = [
        ["scan", "moves", *(f"{axis} (m)" for axis in axes), *heads, "step (m/line)", "turn (deg/line)"]
    ]
    for index in range(len(cameras)):
        lines = cameras.key_poses.of(index).poses.double().numpy()
        name = f"view_{index:03d}"
        quaternions = Rotation.from_matrix(lines[:, :, :3]).as_quat()[:, [3, 0, 1, 2]]
        for row, (pose, quaternion) in enumerate(zip(lines, quaternions, strict=True)):
            of_lines.append([name, str(row), *_texts(pose[:, 3]), *_texts(quaternion)])
        first, empty = lines[0], [""] * 3
        start = [name, "camera", *_texts(first[:, 3]), *_texts(-first[:, 2])]
        if is_from_arm(index):
            centre = _texts(np.zeros(3))
            of_stages.append(
                [*start, *empty, *_texts(np.array(_AXIS)), *centre, "", f"{360 / len(lines):.12g}"]
            )
        else:
            step = f"{_SWEEP / len(lines):.12g}"
            of_stages.append([*start, *_texts(-first[:, 1]), *empty, *empty, step, ""])
    write_file(folder / LINE_POSES, csv_bytes(of_lines))
    write_file(folder / STAGES, csv_bytes(of_stages))


def _texts(values: Float64[np.ndarray, " n"]) -> list[str]:
    return [f"{value:.9g}" for value in values]


SCANNED = Place(speckled_things(), scanning_cameras)
"""The table with speckles, and the cameras that scan it."""
STAGES_FILE = PosesFile(STAGES, _write_line_poses)
