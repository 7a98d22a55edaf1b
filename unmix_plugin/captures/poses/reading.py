"""Poses of any program that we know, found by content. Read here: LLFF's, Polycam's, and transforms.json, which may be
nerfstudio's, Blender's with `camera_angle_x`, a bare list, or have rotations with scale.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from unmix_plugin.captures.names import BY_ORDER, path_text, size_of_view
from unmix_plugin.captures.poses import lens as models
from unmix_plugin.captures.poses.colmap import find_models, is_model, read_colmap
from unmix_plugin.captures.poses.lens import Lens, distorted_lens
from unmix_plugin.captures.poses.metashape import read_metashape
from unmix_plugin.captures.poses.micmac import find_orientations, read_micmac
from unmix_plugin.captures.poses.opensfm import read_opensfm
from unmix_plugin.captures.poses.pose_set import (
    FLIP,
    PosedCamera,
    PoseSet,
    SparsePoints,
    load_json,
    load_xml,
    make_pose_set,
    reading,
)
from unmix_plugin.captures.poses.realitycapture import is_realitycapture, read_realitycapture
from unmix_plugin.errors import CaptureError, counted, name_some
from unmix_plugin.formats.json_values import describe, read_number, read_numbers
from unmix_plugin.formats.meshes import read_ply_points
from unmix_plugin.limits import allow_parts, open_regular
from unmix_plugin.scenes.folder import Transforms, parse_transforms, unfollowed_keys
from unmix_plugin.scenes.frame_cameras import Intrinsics, read_lens
from unmix_plugin.scenes.placement import read_placement
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, map_array, read_array_header
from unmix_plugin.scenes.reading.faults import FILE_NAME, Faults, find_named
from unmix_plugin.scenes.reading.images import FORMATS

_KNOWN = (
    "transforms.json, a COLMAP model (.bin or .txt), Metashape's cameras as XML, RealityCapture's camera parameters as "
    "CSV, OpenSfM's reconstruction.json, MicMac's Orientation-*.xml, Polycam's cameras or LLFF's poses_bounds.npy"
)
_SPLIT_FILES = tuple(f"transforms_{split}.json" for split in ("train", "val", "eval", "test"))
_LLFF_FILE, _LLFF_PICTURES = "poses_bounds.npy", ("images", "exr")
"""Poses, and the folders with the pictures, in the order of whose names the poses come."""
_Size: TypeAlias = tuple[int, int]
"""Width, height in pixels."""


def read_poses(path: Path, picture_sizes: Mapping[str, _Size] | None = None) -> PoseSet:
    """Poses of a file or folder, whichever program wrote it. Raises CaptureError: nothing known is there, or what is
    there is damaged or can't be represented.

    Args:
        picture_sizes: Of views by name, file name or stem, for sources that have no sizes and no pictures.
    """
    if not path.exists():
        raise CaptureError(f"{path} is not there; give a file or folder with poses: {_KNOWN}")
    return (_read_folder if path.is_dir() else _read_file)(path, picture_sizes or {})


def _read_file(path: Path, given: Mapping[str, _Size]) -> PoseSet:
    start = _first_bytes(path).lstrip(b"\xef\xbb\xbf\xff\xfe\0\t\r\n ")
    if path.suffix in (".bin", ".txt") and is_model(path.parent):
        return read_colmap(path.parent)
    if start[:1] in (b"{", b"["):
        return _read_json(path, given)
    if start[:1] == b"<":
        return _read_xml(path)
    if start.startswith(b"\x93NUMPY"):
        return _read_llff(path)
    if is_realitycapture(start):
        return read_realitycapture(path, given)
    hint = ": export the cameras as XML" if path.suffix in (".psx", ".psz") else ""
    raise CaptureError(f"{path} holds no poses that we know; expected {_KNOWN}{hint}")


def _read_json(path: Path, given: Mapping[str, _Size]) -> PoseSet:
    content = load_json(path)
    if _is_polycam(content):
        return _read_polycam(_find_polycam(path.parent) or [path])
    frames = content if isinstance(content, list) else []  # a bare list of those of transforms.json
    has_frames = any(isinstance(frame, dict) and "transform_matrix" in frame for frame in frames)
    if has_frames or (isinstance(content, dict) and "frames" in content):
        return read_transforms({path: content}, given)
    return read_opensfm(path, content)


def _read_xml(path: Path) -> PoseSet:
    root = load_xml(path)
    if root.tag == "document" or root.find("chunk") is not None:
        return read_metashape(path, root)
    if root.tag in ("ExportAPERO", "OrientationConique"):
        return read_micmac(find_orientations(path.parent) or [path])
    raise CaptureError(
        f"{path} is XML with the root <{root.tag}>; expected Metashape's <document> or MicMac's <ExportAPERO>"
    )


def _read_folder(folder: Path, given: Mapping[str, _Size]) -> PoseSet:
    """The poses of a folder; where several programs left some, those of the first kind, and the others are named."""
    found: list[tuple[str, Callable[[], PoseSet]]] = []
    if (folder / "transforms.json").is_file():
        found.append(("transforms.json", lambda: _read_json(folder / "transforms.json", given)))
    splits = [folder / name for name in _SPLIT_FILES if (folder / name).is_file()]
    if splits:
        names = ", ".join(path.name for path in splits)
        found.append((names, lambda: read_transforms({path: load_json(path) for path in splits}, given)))
    if models := find_models(folder):
        found.append(("a COLMAP model", lambda: _greatest_model(models)))
    plain = [name for name in ("reconstruction.json", _LLFF_FILE) if (folder / name).is_file()]
    found += [(name, lambda name=name: _read_file(folder / name, given)) for name in plain]
    if orientations := find_orientations(folder):
        found.append(("MicMac's orientations", lambda: read_micmac(orientations)))
    elif sheets := [path for path in sorted(folder.glob("*.xml")) if b"<document" in _first_bytes(path)]:
        found.append((sheets[0].name, lambda: _read_xml(sheets[0])))
    if tables := [path for path in sorted(folder.glob("*.csv")) if is_realitycapture(_first_bytes(path))]:
        found.append((tables[0].name, lambda: read_realitycapture(tables[0], given)))
    if phone := _find_polycam(folder):
        found.append(("Polycam's cameras", lambda: _read_polycam(phone)))
    if not found:
        raise CaptureError(f"{folder} holds no poses that we know; expected {_KNOWN}")
    (name, read), *others = found
    poses = read()
    if not others:
        return poses
    ignored = " and ".join(other for other, _ in others)
    return replace(poses, notes=(*poses.notes, f"{folder} has {ignored} too; {name} was read"))


def _greatest_model(models: list[Path]) -> PoseSet:
    """The model with the most images, the first of several."""
    found = sorted((read_colmap(model) for model in models), key=lambda model: -len(model.cameras))
    if len(found) == 1:
        return found[0]
    others = [f"{other.source} ({counted(len(other.cameras), 'image')})" for other in found[1:]]
    note = (
        f"{len(models)} COLMAP models are there; {found[0].source} has the most images "
        f"({len(found[0].cameras)}) and was read, not {name_some(others)}"
    )
    return replace(found[0], notes=(*found[0].notes, note))


def _first_bytes(path: Path) -> bytes:
    with reading(path), open_regular(path) as file:
        return file.read(512)


def _read_llff(path: Path) -> PoseSet:
    """poses_bounds.npy, (N, 17): a 3 x 5 matrix [R | t | h, w, f] (axes down, right, back), near, far. Cameras have the
    names of the pictures beside it, where there are as many."""
    try:
        with reading(path):
            read_array_header(path)
            mapped = map_array(path)
    except UnreadableArrayError as error:
        raise CaptureError(f"{path} {error}") from error
    if mapped.ndim != 2 or not len(mapped) or mapped.shape[1] not in (15, 17):
        raise CaptureError(
            f"{path} has the shape {mapped.shape}; expected (views, 17) numbers, as LLFF writes them"
        )
    with np.errstate(invalid="ignore"):  # NaN is refused with all that is no pose
        table = np.array(mapped, dtype=np.float64)
    names = [f"{BY_ORDER}{index:04d}" for index in range(len(table))]
    note = "poses have no names: they go by the order of views"
    for place in [path.parent / name for name in reversed(_LLFF_PICTURES) if (path.parent / name).is_dir()]:
        there = sorted(entry.name for entry in place.iterdir() if not entry.name.startswith("."))
        if len(there) == len(table):
            names = [f"{place.name}/{name}" for name in there]
            note = f"poses are those of {place.name}/ in the order of names"
    cameras = []
    for name, row in zip(names, table[:, :15].reshape(-1, 3, 5), strict=True):
        down, right, back, position, (height, width, focal) = row.T
        if not (1 <= width <= 1e6 and 1 <= height <= 1e6 and 0 < focal < 1e9):
            numbers = f"{height:g}, {width:g}, {focal:g}"
            raise CaptureError(
                f"{path}: the camera of {name} has height, width, focal length {numbers}; expected pixels above 0"
            )
        center = (float(width) / 2, float(height) / 2)
        lens = Lens(round(width), round(height), (float(focal), float(focal)), center)
        cameras.append((name, PosedCamera(np.column_stack([right, -down, back, position]), lens)))
    return make_pose_set(cameras, f"LLFF's {path.name}", str(path), notes=[note])


# transforms.json.

_NAME_KEYS = ("file_path", "hyperspectral_file_path", "name")
"""Of a frame: the first that is there names its image."""
_PLAIN_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL")
_DISTORTED_MODELS: dict[str, models.Distortion] = {
    "OPENCV_FISHEYE": models.distort_fisheye,
    "FISHEYE624": models.distort_fisheye_624,
    "EQUIRECTANGULAR": models.distort_equirectangular,
}


def read_transforms(contents: Mapping[Path, Any], sizes: Mapping[str, _Size]) -> PoseSet:
    """Poses of what one transforms.json holds, or one for each split. Raises CaptureError: they are none, or can't be
    represented."""
    cameras: list[tuple[str, PosedCamera]] = []
    notes: list[str] = []
    points: SparsePoints | None = None
    warnings: list[str] = []
    up = np.array([0.0, 0.0, 1.0])
    metres: set[float | None] = set()
    for path, content in contents.items():
        faults = Faults(path)
        transforms = parse_transforms(content, faults)
        faults.raise_if_any(CaptureError)
        faults = Faults(path.parent if path.name == FILE_NAME else path)
        warned, noted = unfollowed_keys(transforms.scene, [frame for _, frame in transforms.frames])
        placement, metres_per_unit = read_placement(transforms.scene, path.name, faults)
        metres.add(metres_per_unit)
        found = _read_frames(path, transforms, sizes, faults, warned, noted)
        faults.raise_if_any(CaptureError)
        if not placement.is_identity:
            noted.append("applied_transform and applied_scale are undone")
        for (name, *others), matrix, lens in found:
            position = placement.to_source(matrix[:, 3])
            matrix = np.column_stack([placement.rotation.T @ matrix[:, :3], position])
            cameras.append((name, PosedCamera(matrix, lens, tuple(others))))
        name = transforms.scene.get("ply_file_path")
        if points is None and isinstance(name, str):
            try:
                positions, colours = read_ply_points(find_named(path.parent, name) or path.parent / name)
                points = placement.to_source(positions), colours
            except (OSError, ValueError) as error:
                noted.append(f"the sparse points of {name} can't be read ({error}); left out")
        up = placement.rotation.T @ np.array([0.0, 0.0, 1.0])
        warnings += [f"{path.name}: {text}" for text in dict.fromkeys(warned)]
        notes += [f"{path.name}: {text}" for text in dict.fromkeys(noted)]
    where = ", ".join(str(path) for path in contents)
    source = " and ".join(path.name for path in contents)
    made = make_pose_set(cameras, source, where, points, up, notes, warnings)
    return replace(made, metres_per_unit=metres.pop() if len(metres) == 1 else None)


def _read_frames(
    path: Path,
    transforms: Transforms,
    sizes: Mapping[str, _Size],
    faults: Faults,
    warnings: list[str],
    notes: list[str],
) -> list[tuple[list[str], Float64[np.ndarray, "3 4"], Lens | None]]:
    """Names, matrix and lens of each frame, in the file's own world."""
    top = transforms.scene
    lenses: dict[str, Lens | None] = {}
    read, missing = [], []
    for index, (place, frame) in enumerate(transforms.frames):
        where = f"{path}: {place}"
        texts = [frame[key] for key in _NAME_KEYS if isinstance(frame.get(key), str) and frame[key].strip()]
        names = [path_text(text) for text in texts] or [f"#{index:04d}"]
        # Blender's files leave out the suffix.
        picture = find_named(path.parent, names[0]) or find_named(path.parent, f"{names[0]}.png")
        missing += [] if picture else [names[0]]
        matrix = _read_matrix(frame.get("transform_matrix"), where)
        if frame.get("from_na", top.get("from_na")):
            notes.append("'from_na' is set: cameras have OpenCV's axes, as NeuS2 writes them")
            matrix[:, :3] = matrix[:, :3] @ FLIP
        model, terms = _terms_of_other_models(top | frame, where)
        common, of_frame = top, frame
        if terms:  # whose list is not that of the keys k1 to p2
            common, of_frame = (
                {key: one[key] for key in one if key != "distortion_params"} for one in (top, frame)
            )
        given, lens = read_lens(common, of_frame, place, faults), None
        if given is not None:
            if given.width is not None and given.height is not None:
                size = (given.width, given.height)
            else:
                size = _size_of(picture, names[0], given, sizes, where)
                if size is not None and picture is None and given.focal_px != (None, None):
                    warnings.append(
                        "'w' and 'h' are absent, and so are pictures that it names: focal lengths are taken in pixels "
                        "of the views; add 'w' and 'h' if they are those of other pictures"
                    )
            key = repr((given, size, terms))  # many frames share a lens, which takes long to fit
            if key not in lenses:
                lenses[key] = None if size is None else _make_lens(given, model, terms, size, where)
            lens = lenses[key]
        read.append((names, matrix, lens))
    if missing:
        named = f"{len(missing)} of {len(read)} frames name files that are not there ({name_some(missing)})"
        notes.append(f"{named}; their poses are kept")
    if any(lens is None for _, _, lens in read):
        notes.append("frames without a focal length or picture size have no lens")
    return read


def _size_of(
    picture: Path | None, name: str, lens: Intrinsics, sizes: Mapping[str, _Size], where: str
) -> _Size | None:
    """Size of the picture of a frame; where it is not there, that of the view of its name among those given. Raises
    CaptureError: the lens is that of a larger picture than this view."""
    from PIL import Image

    if picture is not None:
        unreadable = suppress(OSError, ValueError, Image.DecompressionBombError)
        with unreadable, open_regular(picture) as file, Image.open(file, formats=FORMATS) as opened:
            return opened.size
    size = size_of_view(name, sizes)
    x, y = lens.center_px
    if size is not None and ((x or 0.0) >= size[0] or (y or 0.0) >= size[1]):
        found = ", ".join(
            f"'{key}' is {value:g}" for key, value in (("cx", x), ("cy", y)) if value is not None
        )
        raise CaptureError(
            f"{where}: {found}, outside the view's {size[0]} x {size[1]} pixels, so the lens is that of another "
            f"picture; add its size as 'w' and 'h', or put {name} where the file names it"
        )
    return size


def _terms_of_other_models(values: dict[str, Any], where: str) -> tuple[str | None, tuple[float, ...]]:
    """Name and terms of a lens model that keys of its own describe: instant-ngp's ftheta, nerfstudio's FISHEYE624."""
    if values.get("ftheta_p0") is not None:
        model, what, count = "ftheta", "'ftheta_p0' to 'ftheta_p5'", 6
        listed = [values.get(f"ftheta_p{power}", 0.0) for power in range(count)]
    elif str(values.get("camera_model")).upper() == "FISHEYE624":
        model, what, count = "FISHEYE624", "'distortion_params' of FISHEYE624", 12
        listed = values.get("distortion_params")
    else:
        return None, ()
    terms = read_numbers(listed, count)
    if terms is None:
        raise CaptureError(f"{where}: {what} are {describe(listed)}; expected {count} numbers")
    if model == "ftheta" and not terms[1] > 0:
        raise CaptureError(f"{where}: 'ftheta_p1' is {terms[1]:g}; expected pixels per radian above 0")
    return model, tuple(terms.tolist())


def _make_lens(
    given: Intrinsics, other_model: str | None, terms: tuple[float, ...], size: _Size, where: str
) -> Lens | None:
    """The lens, or the one that stands for it; None without a focal length."""
    width, height = size
    x, y = given.center_px
    center, focal = (width / 2 if x is None else x, height / 2 if y is None else y), given.focal_at(*size)
    model = other_model or given.model
    distort: models.Distortion | None = _DISTORTED_MODELS.get(model) if isinstance(model, str) else None
    if model == "ftheta":  # by its terms alone, never by `camera_model`
        distort, focal, terms = (
            models.distort_ftheta,
            (1.0 / terms[1], 1.0 / terms[1]),
            (math.hypot(*size), *terms),
        )
    elif distort is models.distort_equirectangular:
        focal = (width / (2 * math.pi), height / math.pi)
    elif distort is models.distort_fisheye:
        distort = partial(models.distort_fisheye, tangential=given.distortion[2:])
        terms = (*given.distortion[:2], *given.higher_radial)
    if focal is None:
        return None
    if model in _PLAIN_MODELS:
        return Lens(*size, focal, center, given.distortion, given.higher_radial)
    if distort is None:
        raise CaptureError(
            f"{where}: camera_model {describe(model)} is not known; expected one of "
            f"{', '.join((*_PLAIN_MODELS, *_DISTORTED_MODELS))}: undistort the images first"
        )
    return distorted_lens(distort, terms, Lens(*size, focal, center), model, where)


def _read_matrix(value: Any, where: str) -> Float64[np.ndarray, "3 4"]:
    """A matrix of 3 or 4 rows, or 12 or 16 numbers row by row; NaN is kept for the check that names all such frames."""
    rows: list[Any] = value if isinstance(value, list) else []
    if not any(isinstance(row, list) for row in rows):
        rows = [rows[start : start + 4] for start in range(0, len(rows), 4)]
    if len(rows) not in (3, 4) or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        found = "absent" if value is None else describe(value)
        raise CaptureError(
            f"{where}: 'transform_matrix' is {found}; expected 4 (or 3) rows of 4 numbers, camera to world"
        )
    numbers = [[read_number(number) for number in row] for row in rows]
    matrix = np.array([[math.nan if number is None else number for number in row] for row in numbers])
    if len(matrix) == 4 and np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-6 and matrix[3].any():
        raise CaptureError(
            f"{where}: the last row of 'transform_matrix' is {matrix[3].tolist()}; expected 0, 0, 0, 1"
        )
    return matrix[:3]


# Polycam's raw data: keyframes/cameras/NUMBER.json, one for each of keyframes/images/NUMBER.jpg. `t_00` to `t_23` are
# the rows of camera to world, with OpenGL's axes of the camera and +y of the world up; `fx`, `fy`, `cx`, `cy`, `width`,
# `height` in pixels. Cameras that Polycam optimised stand in corrected_cameras.
# Sources: Polycam, raw data; nerfstudio, process_data/polycam_utils.py.

_CORRECTED, _RAW = "corrected_cameras", "cameras"
_MATRIX = [f"t_{row}{column}" for row in range(3) for column in range(4)]


def _is_polycam(content: Any) -> bool:
    """Whether JSON is a camera of Polycam's."""
    return isinstance(content, dict) and all(key in content for key in (*_MATRIX, "fx"))


def _find_polycam(folder: Path) -> list[Path]:
    """Cameras in a folder of raw data, its keyframes/, or one of these folders itself; corrected ones if there are."""
    for place in (folder / "keyframes", folder):
        for name in (_CORRECTED, _RAW):
            if found := sorted((place / name).glob("*.json")):
                return found
    return sorted(folder.glob("*.json")) if folder.name in (_CORRECTED, _RAW) else []


def _read_polycam(paths: list[Path]) -> PoseSet:
    """Poses of camera files. Raises CaptureError: one is damaged or none of Polycam's."""
    folder = paths[0].parent
    allow_parts(folder, len(paths), "cameras", CaptureError, 1 << 16)
    cameras = []
    for path in paths:
        content = load_json(path)
        if not _is_polycam(content):
            raise CaptureError(f"{path} is no camera of Polycam's: it lacks 't_00' to 't_23' or 'fx'")
        keys = [*_MATRIX, "fx", "fy", "cx", "cy", "width", "height"]
        numbers = {key: read_number(content.get(key)) for key in keys}
        if missing := [key for key, value in numbers.items() if value is None]:
            raise CaptureError(f"{path}: {', '.join(missing)} should be numbers")
        values = {key: float(value or 0.0) for key, value in numbers.items()}
        if not (min(values["fx"], values["fy"]) > 0 and 1 <= min(values["width"], values["height"]) <= 1e6):
            raise CaptureError(f"{path}: fx, fy, width or height are not above 0")
        size = round(values["width"]), round(values["height"])
        lens = Lens(*size, (values["fx"], values["fy"]), (values["cx"], values["cy"]))
        pose = np.array([values[key] for key in _MATRIX]).reshape(3, 4)
        cameras.append((path.stem, PosedCamera(pose, lens)))
    up = np.array([0.0, 1.0, 0.0])
    note = "those that Polycam optimised" if folder.name == _CORRECTED else "as the phone tracked them"
    return make_pose_set(cameras, f"Polycam's {folder.name}", str(folder), None, up, [f"cameras are {note}"])
