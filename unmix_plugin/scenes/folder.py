"""transforms.json: the one schema of its keys, for all who read and write such files.

The form is nerfstudio's with the keys of UnMix-NeRF and ours. A key of a frame comes before the same key of the scene.
What other programs write is listed too: keys that change geometry or values and can't be followed are refused or
named, and so are keys that nobody knows.

Sources: instant-ngp (src/nerf_loader.cu: read_lens, read_focal_length, load_nerf), NeuS2 (the same file), nerfstudio
(data/dataparsers: nerfstudio_dataparser.py, instant_ngp_dataparser.py, dnerf_dataparser.py; cameras/camera_utils.py),
3dgs-deblur (train.py) and Metashape's lens terms (b1, b2) as exporters of its cameras write them.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from jaxtyping import Float64
from msgspec import Meta

from unmix_plugin.formats.json_values import describe, read_keys
from unmix_plugin.limits import GREATEST_PX, UnreadableJsonError, read_json
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.reading.faults import FILE_NAME, Faults

CUBE_KEY = "hyperspectral_file_path"
METRES_KEY, METRES_RANGE = "metres_per_unit", (1e-9, 1e9)
"""Metres in a unit of the world that poses come from, also in a run's record; least and greatest."""

PathText = Annotated[str, Meta(pattern=r"\A[^\x00-\x1f]+\Z", description="a path")]
_Pixels = Annotated[float, Meta(ge=1, le=GREATEST_PX, multiple_of=1, description="a whole number of pixels")]
_Focal = Annotated[
    float, Meta(ge=1 / GREATEST_PX, le=GREATEST_PX, description="a focal length above 0 in pixels")
]
_Radians = Annotated[float, Meta(ge=1e-6, le=math.pi - 1e-6, description="radians between 0 and pi")]
_Degrees = Annotated[float, Meta(ge=1e-4, le=180 - 1e-4, description="degrees between 0 and 180")]
_Term = Annotated[float, Meta(ge=-GREATEST_PX, le=GREATEST_PX, description="a finite number, at most 1e9")]
_Scale = Annotated[float, Meta(ge=1e-30, le=1e30, description="what stands for 1, above 0")]
_Metres = Annotated[
    float, Meta(ge=METRES_RANGE[0], le=METRES_RANGE[1], description="1e-9 to 1e9, such as 0.001 for mm")
]
_Paths = Annotated[list[str], Meta(description="a list of file paths")]
_Coordinate = Annotated[float, Meta(ge=-1e9, le=1e9)]
_Markers = Annotated[
    dict[str, Annotated[list[tuple[_Coordinate, _Coordinate, _Coordinate]], Meta(min_length=1)]],
    Meta(description="a list of points x, y, z for each name"),
]


class _MovingFrame(msgspec.Struct, kw_only=True, frozen=True):
    """Axes that turn with the camera about a middle."""

    kind: Annotated[str, Meta(pattern=r"\A(turntable|camera)\Z", description="turntable or camera")]
    middle: tuple[_Coordinate, _Coordinate, _Coordinate]
    axis: tuple[_Coordinate, _Coordinate, _Coordinate]


class LensKeys(msgspec.Struct, kw_only=True, frozen=True):
    """The lens of a frame, or of the scene for all frames that have none of their own."""

    w: _Pixels | None = None
    h: _Pixels | None = None
    fl_x: _Focal | None = None
    fl_y: _Focal | None = None
    camera_angle_x: _Radians | None = None
    """Field of view along x; of one given twice, that in degrees counts, as in nerfstudio."""
    camera_angle_y: _Radians | None = None
    x_fov: _Degrees | None = None
    y_fov: _Degrees | None = None
    cx: _Term | None = None
    cy: _Term | None = None
    k1: _Term | None = None
    k2: _Term | None = None
    k3: _Term | None = None
    """Radial term of the sixth power."""
    k4: _Term | None = None
    """Radial term of the eighth power."""
    p1: _Term | None = None
    p2: _Term | None = None
    distortion_params: Any = None
    """nerfstudio's list of k1, k2, k3, k4, p1, p2."""
    camera_model: Any = None
    is_fisheye: Any = None
    """instant-ngp's word for OPENCV_FISHEYE."""
    intrinsic_matrix: Any = None
    """NeuS2's focal lengths and principal point, 3 rows of 3 numbers."""


class FrameKeys(msgspec.Struct, kw_only=True, frozen=True):
    """What is followed in a frame, beside its lens, and nowhere else."""

    transform_matrix: Any = None
    """Camera to world, OpenGL axes."""
    row_poses: Any = None
    """Of a line camera: a pose per row."""
    key_poses: Any = None
    """Of a line camera: poses of some rows."""
    file_path: PathText | None = None
    hyperspectral_file_path: PathText | None = None
    seg_file_path: PathText | None = None
    mask_path: PathText | None = None
    abundance_file_path: PathText | None = None
    responses_path: PathText | None = None
    sensor: Annotated[str, Meta(pattern=r"\S", description="a name")] | None = None
    bands: (
        Annotated[list[int], Meta(min_length=1, description="indices into 'wavelengths', one a channel")]
        | None
    ) = None
    capture: Annotated[str | int, Meta(description="the name of a shot")] | None = None
    """One for all lenses of a rig."""

    @property
    def shot(self) -> str | None:
        """Name of the shot."""
        return None if self.capture is None else str(self.capture)

    @property
    def paths(self) -> dict[str, str]:
        """Paths by their key, with slashes."""
        named = {key: getattr(self, key) for key in FILE_KEYS}
        return {key: text.replace("\\", "/") for key, text in named.items() if text is not None}


FILE_KEYS = tuple(key for key in FrameKeys.__struct_fields__ if key.endswith("_path"))


class WorldKeys(msgspec.Struct, kw_only=True, frozen=True):
    """The world that the poses are in, see `placement.Placement`; beside `frames`, and nowhere else."""

    applied_transform: Any = None
    """3 x 4."""
    applied_scale: Annotated[float, Meta(ge=1e-12, le=1e12, description="a number above 0")] | None = None
    offset: Any = None
    metres_per_unit: _Metres | None = None


class SceneKeys(msgspec.Struct, kw_only=True, frozen=True):
    """What else is followed beside `frames`, and nowhere else."""

    wavelengths: Any = None
    """Centres of the B bands, nm, increasing."""
    fwhm: Any = None
    """Their widths, nm; 0 or null where one is unknown."""
    value_scale: _Scale | None = None
    """Stored number that stands for 1."""
    train_filenames: _Paths | None = None
    val_filenames: _Paths | None = None
    test_filenames: _Paths | None = None
    materials: Any = None
    """Names of the true materials."""
    illuminant_path: PathText | None = None
    endmembers_path: PathText | None = None
    datadir: Any = None
    """Of HSI-Nerfstudio: where the files of frames are."""
    ply_file_path: Any = None
    """Sparse points of structure from motion."""
    left_out: Any = None
    """Views that are no frames, as they are spoilt."""
    markers: _Markers | None = None
    """Corners of printed markers, or single points, by name, in the world of the poses as they are written."""
    calibrated_value_of_1: Any = None
    """What 1 stands for in the unit that was measured, where values were divided."""
    reflectance_of_1: (
        Annotated[float, Meta(ge=1e-30, le=1e30, description="a reflectance, above 0")] | None
    ) = None
    """Reflectance that 1 stands for, where values are reflectances that were divided by it; in the light of the scene a
    white is 1 over it."""
    mesh_path: PathText | None = None
    """This and the following are of an object, see `neumatex`."""
    environment_path: PathText | None = None
    environment_rotation_deg: (
        Annotated[float, Meta(ge=-1e6, le=1e6, description="a number from -1e+06 to 1e+06")] | None
    ) = None
    environment_exposure_stops: (
        Annotated[float, Meta(ge=-20, le=20, description="a number from -20 to 20")] | None
    ) = None
    environment_moves: _MovingFrame | None = None
    """Of light that turns with the camera: the frame in which it stands still."""
    tone_mapping: Any = None


_HINTS = frozenset(
    """
    name frames dino_file_path aabb aabb_scale scale render_aabb up n_extra_learnable_dims importance_sampling
    integer_depth_scale enable_depth_loading enable_ray_loading sharpen sharpness_discard_threshold sharpness depth_path
    depth_file_path depth_unit_scale_factor driver_parameters envmap orientation_override colmap_im_id rotation time
    transform_matrix_start format_version space fps split poses_refined
    """.split()  # noqa: SIM905
)
"""Keys of both that move no pose: hints for rendering and training, and what our own camera files have beside."""
_OF_ALL_CUBES = ("value_scale", "wavelengths", "fwhm")
"""Of the scene's, what makes values wrong where a frame has others."""
_PLACING = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
_LENS_OF_NERFSTUDIO = (*_PLACING, "distortion_params", "camera_model")
"""Lens keys of frames, which nerfstudio does not look at where the scene has them."""
_UNDISTORT = "undistort the pictures and write the poses with a pinhole or OPENCV lens"
_ONLY_IN_CAPTURES = {
    **dict.fromkeys(
        (f"ftheta_p{power}" for power in range(6)),
        f"an ftheta lens (instant-ngp); {_UNDISTORT}: unmix-process does both",
    ),
    "from_na": "camera axes of OpenCV (NeuS2), +y down and +z forwards; change the signs of the second and third "
    "column of every transform_matrix and take the key out: unmix-process does both",
}
"""What unmix-process follows: it resamples pictures and turns cameras; scenes may not have it."""
_REFUSED = {
    "latlong": f"pictures of all directions (instant-ngp); {_UNDISTORT}",
    "equirectangular": f"pictures of all directions (instant-ngp); {_UNDISTORT}",
    "orthographic": f"parallel rays (instant-ngp); {_UNDISTORT}",
    "fisheye624_params": f"a lens of Project Aria (nerfstudio); {_UNDISTORT}",
    **dict.fromkeys(("k5", "k6"), f"radial terms of higher powers than k4; {_UNDISTORT}"),
    **dict.fromkeys(("s1", "s2", "s3", "s4"), f"thin prism terms of OpenCV; {_UNDISTORT}"),
    **dict.fromkeys(("b1", "b2", "skew"), f"pixels that are skewed or not square (Metashape); {_UNDISTORT}"),
    **dict.fromkeys(
        ("from_mitsuba", "normal_mts_args"),
        "camera axes of Mitsuba (instant-ngp), +x left and +z forwards; change the signs of the first and third column "
        "of every transform_matrix and take the key out",
    ),
}
"""What a key stands for and what to do, by key. Zero, false and null are as if it was not there."""
_NOT_FOLLOWED = {
    "rolling_shutter": "rows that were read one after the other (instant-ngp): each picture gets one pose",
    "rolling_shutter_time": "rows that were read one after the other (3dgs-deblur): each picture gets one pose",
    "transform_matrix_end": "a camera that moved during the exposure (instant-ngp): each picture gets one pose",
    "camera_linear_velocity": "a camera that moved during the exposure (3dgs-deblur): each picture gets one pose",
    "fisheye_crop_radius": "pixels that nerfstudio leaves out around a circle: give masks",
    "white_transparent": "white pixels that instant-ngp takes for background: --mask white leaves them out",
    "black_transparent": "black pixels that instant-ngp takes for background: --mask black leaves them out",
    "fix_premult": "colours that instant-ngp divides by their opacity: they are taken as they are",
}
"""What a key stands for that is named in a warning, by key."""


def refused_keys(scene: Mapping[str, Any], frame: Mapping[str, Any], is_scene: bool = False) -> list[str]:
    """Faults of a frame: keys that are set and stand for what can't be represented.

    Args:
        is_scene: Whether rays are cast through the lens and from the pose as they are; captures bring both into ours.

    >>> refused_keys({"latlong": False, "k6": 0.01}, {})[0][:53]
    "'k6' is set, which stands for radial terms of higher "
    """
    refused = [
        Message.KEY_REFUSED.sentence(key=key, meaning=meaning)
        for key, meaning in (_REFUSED | (_ONLY_IN_CAPTURES if is_scene else {})).items()
        if _is_set(frame.get(key, scene.get(key)))
    ]
    return refused + [
        Message.KEY_OF_ONE_CUBE.sentence(key=key)
        for key in _OF_ALL_CUBES
        if frame.get(key) not in (None, scene.get(key))
    ]


def unfollowed_keys(
    scene: Mapping[str, Any], frames: Iterable[Mapping[str, Any]]
) -> tuple[list[str], list[str]]:
    """Warnings of keys that change something and are not followed; notes of keys that we have no word for."""
    frames = list(frames)
    every = [scene, *frames]
    warnings = [
        Message.KEY_NOT_FOLLOWED.sentence(key=key, meaning=meaning)
        for key, meaning in _NOT_FOLLOWED.items()
        if any(_is_set(values.get(key)) for values in every)
    ]
    if scene.get("space") not in (None, "world"):
        meaning = "cameras in the model space of a run; write them in the world that its scene has"
        warnings.append(Message.KEY_NOT_FOLLOWED.sentence(key="space", meaning=meaning))
    twice = [
        key
        for key in _LENS_OF_NERFSTUDIO
        if scene.get(key) is not None and any(one.get(key) not in (None, scene[key]) for one in frames)
    ]
    if twice and not any("sensor" in one for one in frames):  # which nerfstudio has no word for
        warnings.append(Message.LENS_TWICE.sentence(keys=", ".join(twice)))
    if len({repr(one["time"]) for one in frames if "time" in one}) > 1:
        warnings.append(Message.TIME.sentence())
    of_scenes = {*WorldKeys.__struct_fields__, *SceneKeys.__struct_fields__}
    of_frames = set(FrameKeys.__struct_fields__)
    if misplaced := [key for key in scene if key in of_frames and _is_set(scene[key])]:
        warnings.append(Message.NOT_BESIDE_FRAMES.sentence(keys=", ".join(misplaced)))
    in_frames = [
        key
        for key in sorted(of_scenes.difference(_OF_ALL_CUBES))
        if any(one.get(key) not in (None, scene.get(key)) for one in frames)
    ]
    if in_frames:
        warnings.append(Message.NOT_IN_FRAMES.sentence(keys=", ".join(in_frames)))
    known = of_scenes.union(of_frames, LensKeys.__struct_fields__, _HINTS)
    known |= {*_REFUSED, *_ONLY_IN_CAPTURES, *_NOT_FOLLOWED}
    unknown = sorted({key for values in every for key in values} - known)
    notes = [Message.UNKNOWN_KEYS.sentence(keys=", ".join(unknown[:8]))] if unknown else []
    return warnings, notes


def _is_set(value: Any) -> bool:
    """Whether a value is more than zero, false or nothing, also in a list."""
    pending = [value]
    while pending:
        one = pending.pop()
        if isinstance(one, list):
            pending += one
        elif one:
            return True
    return False


def read_frame_keys(frame: Mapping[str, Any], where: str, faults: Faults) -> FrameKeys:
    """The keys of a frame, checked; whether its bands exist is asked later."""
    keys = read_keys(frame, FrameKeys, partial(faults.note, where, Message.WRONG_VALUE))
    if frame.get("bands") is None:
        return keys
    if frame.get("responses_path") is not None:
        faults.note(where, Message.BANDS_AND_RESPONSES)
    repeated = sorted(band for band, count in Counter(keys.bands).items() if count > 1)
    if repeated:
        faults.note(where, Message.BANDS_REPEAT, bands=", ".join(map(str, repeated)))
    return keys


def read_scene_keys(scene: Mapping[str, Any], faults: Faults) -> SceneKeys:
    """The keys of a scene, each checked by itself."""
    return read_keys(scene, SceneKeys, partial(faults.note, FILE_NAME, Message.WRONG_VALUE))


# Reading and writing.


@dataclass(frozen=True)
class Transforms:
    """A file as it is written: objects whose keys are not yet looked at."""

    scene: dict[str, Any]
    """What holds for all frames."""
    frames: tuple[tuple[str, dict[str, Any]], ...]
    """How messages call each, and what it holds."""


def load_transforms(root: Path, faults: Faults) -> Transforms:
    """What a scene folder's file holds; elements of `frames` that are no objects are noted faults. Raises SceneError:
    it is absent, no JSON object, or has no list of frames, so that there is nothing to go on with."""
    content: Any = None
    if not root.is_dir():
        faults.note(str(root), Message.FOLDER_IS_FILE if root.is_file() else Message.NO_FOLDER)
    elif not (root / FILE_NAME).is_file():
        faults.note(FILE_NAME, Message.NO_FILE)
    else:
        try:
            content = read_json(root / FILE_NAME)
            if not isinstance(content, dict):
                faults.note(FILE_NAME, Message.NO_OBJECT, found=describe(content))
        except OSError as error:
            faults.note(FILE_NAME, Message.FILE_UNREADABLE, reason=error.strerror)
        except UnreadableJsonError as error:
            faults.note(FILE_NAME, Message.NO_JSON, reason=error)
    faults.raise_if_any()
    transforms = parse_transforms(content, faults)
    if not isinstance(content.get("frames"), list):
        faults.raise_if_any()
    if content["frames"] == []:
        faults.note(FILE_NAME, Message.NO_FRAMES)
    return transforms


def parse_transforms(content: Any, faults: Faults, key: str = "frames", what: str = "view") -> Transforms:
    """The scene's keys and the frames in JSON, which may be a bare list of frames; faults are noted where there is no
    list of them, or an element is no object.

    Args:
        key: Which key has the list.
        what: What each of its objects stands for.
    """
    scene = content if isinstance(content, dict) else {}
    frames = scene.get(key) if isinstance(content, dict) else content
    if not isinstance(frames, list):
        found = "is absent" if frames is None else f"is {describe(frames)}"
        faults.note(faults.file, Message.NO_LIST, key=key, found=found, what=what)
        return Transforms(scene, ())
    named = [(f"{key}[{index}]", frame) for index, frame in enumerate(frames)]
    for where, frame in named:
        if not isinstance(frame, dict):
            faults.note(where, Message.FRAME_NO_OBJECT, found=describe(frame))
    return Transforms(scene, tuple((where, frame) for where, frame in named if isinstance(frame, dict)))


def lens_keys(
    focal_px: Sequence[float], center_px: Sequence[float], distortion: Sequence[float]
) -> dict[str, float]:
    """Keys of an OPENCV lens.

    Args:
        distortion: k1, k2, p1, p2, and maybe k3, k4.
    """
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4")
    return {key: float(value) for key, value in zip(keys, (*focal_px, *center_px, *distortion), strict=False)}


def matrix_entry(camera_to_world: Float64[np.ndarray, "3 4"]) -> list[list[float]]:
    """A pose as the four rows of `transform_matrix`."""
    return [*camera_to_world.tolist(), [0.0, 0.0, 0.0, 1.0]]


def transforms_bytes(content: Mapping[str, Any]) -> bytes:
    """What a file of this content holds."""
    return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()
