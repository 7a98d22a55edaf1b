"""A validated scene: posed spectral images, their truth if any, and the box of space they show.

Notation: `N` frames, `B` bands, `K` materials, `H x W` pixels. World space is that of the source of the poses:
that of transforms.json before its `applied_transform`, `applied_scale` and `offset`. Model space is the one that
`Scene.normalisation` maps it to and in which `Scene.cameras` and `Scene.scene_box` are given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float32, Float64, Shaped, UInt8
from msgspec import Meta

from unmix_plugin.engine.decisions import Decision
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.runs.config_json import config_from_json
from unmix_plugin.scenes.backdrops import BeforeBackdrop
from unmix_plugin.scenes.folder import METRES_KEY
from unmix_plugin.scenes.placement import Normalisation, Placement
from unmix_plugin.scenes.reading.cubes import Part, map_array, read_cube, read_invalid
from unmix_plugin.scenes.reading.faults import FILE_NAME
from unmix_plugin.scenes.reading.images import read_colour, read_labels, read_mask
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.sensor import SceneSensor

_COMPARED = ("wavelengths_nm", "frames", "train_indices", "eval_indices", "cameras", "normalisation")


@dataclass(frozen=True)
class Frame:
    """The files of one view."""

    name: str
    """Short name, unique in the scene, fit for file names."""
    cube_path: Path
    """(H, W, B) .npy file."""
    image_path: Path | None
    """sRGB picture, with or without alpha."""
    label_path: Path | None
    """Material indices, 255 = unlabelled."""
    mask_path: Path | None
    """Black where pixels are ignored."""
    abundance_path: Path | None
    """(H, W, K) .npy file of true abundances."""
    sensor: int = 0
    """Which of the scene's sensors took it."""


@dataclass(frozen=True)
class Scene:
    """Everything known about a scene; made by `load_scene` only, which guarantees what is said here."""

    root: Path
    """Scene folder."""
    wavelengths_nm: Float64[np.ndarray, " B"]
    """Band centres in nm, strictly increasing."""
    sensors: tuple[SceneSensor, ...]
    """What takes the frames; each frame of a sensor has the same bands and size."""
    frames: tuple[Frame, ...]
    """All views, in the order of transforms.json."""
    cameras: Cameras
    """One a frame, in model space."""
    train_indices: tuple[int, ...]
    """Frames to train on; at least one."""
    eval_indices: tuple[int, ...]
    """Frames to evaluate on; at least one, none of them trained on."""
    scene_box: SceneBox
    """Model space that is modelled; its longest edge is [-1, 1]."""
    normalisation: Normalisation
    """From world to model space."""
    placement: Placement
    """From world space to that of transforms.json."""
    metres_per_unit: float | None
    """Metres in a unit of world space; None where that is unknown."""
    material_names: tuple[str, ...] | None
    """True materials in the order of labels and abundances."""
    illuminant: Float64[np.ndarray, " B"] | None
    """Relative power of the light a band, greatest value 1."""
    endmembers: Float64[np.ndarray, "K B"] | None
    """True reflectance of each material, [0, 1]."""
    has_alpha: bool
    """Every picture has an alpha channel and at least one pixel of one is not opaque."""
    is_unbounded: bool
    """Pictures show a world behind the scene box, up to the sky."""
    before_backdrop: BeforeBackdrop | None
    """Where something may stand before a plain backdrop that training views without alpha share; None without one."""
    world_reason: str | None
    """Why the world is taken to end with the scene box or not, in words; None where that was set, or follows from alpha
    or a backdrop."""
    warnings: tuple[str, ...]
    """What was left out, or makes the scene doubtful, one sentence each."""
    has_labels: bool
    """Every evaluation frame has labels."""
    has_abundances: bool
    """Every evaluation frame has abundances."""
    input_hashes: dict[str, str]
    """SHA-256 of every file that a training reads, by its path relative to the scene folder."""
    truth_hashes: dict[str, str]
    """The same of files that only an evaluation reads: labels, abundances, endmembers."""
    options: SceneOptions
    """How the scene was read."""
    fwhm_nm: Float64[np.ndarray, " B"] | None = None
    """Widths of the instrument's bands; None where they are unknown."""
    decisions: tuple[Decision, ...] = ()
    """What was concluded from the views when the scene was read."""
    markers: Mapping[str, Float64[np.ndarray, "n 3"]] = field(default_factory=dict)
    """World points of what was marked, by name: the corners of printed markers, or single points."""

    @property
    def cube_hashes(self) -> list[str]:
        """SHA-256 of the cube of each frame."""
        root, paths = self.root, [frame.cube_path for frame in self.frames]
        names = [
            path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path) for path in paths
        ]
        return [self.input_hashes[name] for name in names]

    @property
    def has_backdrop(self) -> bool:
        """Whether the training views have no alpha and share a plain backdrop."""
        return self.before_backdrop is not None

    @property
    def is_rig(self) -> bool:
        """Whether frames differ in bands or size, or don't have the scene's bands in their order."""
        return [sensor.sees_all_bands for sensor in self.sensors] != [True]

    def sensor_of(self, index: int) -> SceneSensor:
        """What took a view."""
        return self.sensors[self.frames[index].sensor]

    def cube(self, index: int, part: Part = ()) -> Float32[np.ndarray, "*pixels b"]:
        """Spectra of a view in [0, 1], as its sensor sees them.

        Values above 1 after the division by `value_scale` are clipped to 1, as a saturated sensor does. Unless
        `invalid_pixels` is `refuse`, spectra of invalid pixels are 0 (see `valid_mask`).
        """
        return read_cube(self.frames[index].cube_path, self.options, part)

    def stored_type(self, index: int) -> str:
        """NumPy's code of a cube's numbers, such as f2 or u2, in any byte order."""
        return map_array(self.frames[index].cube_path).dtype.str[1:]

    def stored_cube(self, index: int, part: Part = ()) -> Shaped[np.ndarray, "*pixels b"]:
        """A cube as it is stored, before any division, in the machine's byte order."""
        stored = map_array(self.frames[index].cube_path)[part]
        return np.array(stored, dtype=stored.dtype.newbyteorder("="), order="C")

    def alpha(self, index: int) -> Float32[np.ndarray, "H W"] | None:
        """Opacity of a view's pixels in [0, 1]; None if the scene has no alpha.

        Cubes are expected as rendered over black, that is multiplied by alpha (premultiplied): a pixel half covered
        by an object holds half its radiance. So is the light behind `srgb`, before its gamma encoding.
        """
        picture = self._picture(index) if self.has_alpha else None
        return None if picture is None else picture[..., 3]

    def srgb(self, index: int) -> Float32[np.ndarray, "H W 3"] | None:
        """sRGB picture of a view in [0, 1], as stored (gamma-encoded); None if it has none."""
        picture = self._picture(index)
        return None if picture is None else picture[..., :3]

    def _picture(self, index: int) -> Float32[np.ndarray, "H W C"] | None:
        path = self.frames[index].image_path
        return (
            None
            if path is None
            else read_colour(path, self._size(index)).astype(np.float32) / np.float32(255)
        )

    def labels(self, index: int) -> UInt8[np.ndarray, "H W"] | None:
        """Material index of each pixel, 255 = unlabelled; None if the view has no labels."""
        path = self.frames[index].label_path
        return None if path is None else read_labels(path, self._size(index))

    def valid_mask(self, index: int, part: Part = ()) -> Bool[np.ndarray, "*pixels"]:
        """True where a pixel counts: not black in the view's mask and not invalid (see `SceneOptions`)."""
        path = self.frames[index].mask_path
        valid = np.ones(self._size(index), bool) if path is None else read_mask(path, self._size(index))
        if self.options.invalid_pixels == "refuse":
            return valid[part]
        return valid[part] & ~read_invalid(self.frames[index].cube_path, self.options, part)

    def abundances(self, index: int) -> Float32[np.ndarray, "H W K"] | None:
        """True abundances of a view; None if it has none."""
        path = self.frames[index].abundance_path
        return None if path is None else np.array(map_array(path), dtype=np.float32, order="C")

    def summary(self) -> dict[str, Any]:
        """What a run has to record of the scene, as JSON-able values."""
        own: dict[str, Any] = {} if self.metres_per_unit is None else {METRES_KEY: self.metres_per_unit}
        if (
            self.is_rig
        ):  # nothing for the scenes of one ordinary camera, so that their records stay as they are
            own["sensors"] = [sensor.to_json() for sensor in self.sensors]
            own["frame_sensors"] = [frame.sensor for frame in self.frames]
        return {
            "root": str(self.root),
            "wavelengths_nm": self.wavelengths_nm.tolist(),
            "frames": [frame.name for frame in self.frames],
            "train_indices": list(self.train_indices),
            "eval_indices": list(self.eval_indices),
            "cameras": self.cameras.to_json(),
            "scene_box": self.scene_box.aabb.tolist(),
            "normalisation": self.normalisation.to_json(),
            "material_names": None if self.material_names is None else list(self.material_names),
            "illuminant": None if self.illuminant is None else self.illuminant.tolist(),
            "endmembers": None if self.endmembers is None else self.endmembers.tolist(),
            **own,
            "has_alpha": self.has_alpha,
            "is_unbounded": self.is_unbounded,
            "has_backdrop": self.has_backdrop,
            "has_labels": self.has_labels,
            "has_abundances": self.has_abundances,
            "input_hashes": dict(self.input_hashes),
            "truth_hashes": dict(self.truth_hashes),
            "options": asdict(self.options),
        }

    def _size(self, index: int) -> tuple[int, int]:
        width, height = self.cameras.size(index)
        return height, width


def scene_identity(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The part of a `Scene.summary` that must agree: views, cameras, bands, and the content of what was measured.

    Where the scene lies doesn't matter, nor its labels and other truth, nor how transforms.json is written: all that
    it says is compared as numbers.
    """
    hashes = dict(summary.get("input_hashes") or {})
    hashes.pop(FILE_NAME, None)
    rig = {key: summary[key] for key in ("sensors", "frame_sensors") if key in summary}
    return {**{key: summary.get(key) for key in _COMPARED}, **rig, "files": hashes}


_LEAST_SIZE = 1e-12  # what is divided by less leaves float32
_Number = Annotated[float, Meta(ge=-1e300, le=1e300)]
_Above0 = Annotated[float, Meta(gt=0, le=1e300)]
_Size = Annotated[float, Meta(gt=_LEAST_SIZE, le=1e300)]
_Three = tuple[_Number, _Number, _Number]


class _RecordedFrame(msgspec.Struct):
    """A `Normalisation` in JSON."""

    rotation: tuple[_Three, _Three, _Three] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: _Three = (0.0, 0.0, 0.0)
    scale: _Size = 1.0
    offset: _Three = (0.0, 0.0, 0.0)


class _RecordedScene(msgspec.Struct):
    """Entries of a data manager's metadata and summary; what a run lacks keeps its default."""

    wavelengths_nm: tuple[_Above0, ...] = ()
    fwhm_nm: tuple[_Above0, ...] | None = None
    illuminant: tuple[Annotated[float, Meta(ge=0, le=1e300)], ...] | None = None
    has_alpha: bool = False
    is_unbounded: bool = False
    has_backdrop: bool = False
    grid_resolution: Annotated[int, Meta(ge=8, le=512)] = 64
    pixel_size: _Size = 1.0
    subpixels: Annotated[int, Meta(ge=1, le=8)] = 1
    num_train_views: Annotated[int, Meta(ge=1)] = 1
    num_train_pixels: Annotated[int, Meta(ge=0)] = 0
    line_rows: tuple[Annotated[int, Meta(ge=0, le=65536)], ...] | None = None
    root: str = ""
    normalisation: _RecordedFrame | None = None
    material_names: tuple[str, ...] | None = None
    endmembers: tuple[tuple[_Number, ...], ...] | None = None
    has_labels: bool = False
    has_abundances: bool = False
    input_hashes: dict[str, str] = {}
    truth_hashes: dict[str, str] = {}
    options: dict[str, Any] = {}


def check_recorded_scene(values: Mapping[str, Any]) -> None:
    """Refuse metadata or a summary that no data manager wrote. Raises ValueError, ConfigError: an entry is of the wrong
    type, or a number out of its range; KeyError, IndexError, TypeError: a sensor is damaged."""
    try:
        scene = msgspec.convert(dict(values), _RecordedScene)
    except msgspec.ValidationError as error:
        raise ValueError(f"the scene: {error}") from error
    config_from_json(scene.options, SceneOptions(), "the scene's options")
    bands = len(scene.wavelengths_nm)
    rules = {
        "wavelengths that increase": all(a < b for a, b in pairwise(scene.wavelengths_nm)),
        "a width for each band": scene.fwhm_nm is None or len(scene.fwhm_nm) == bands,
        "an illuminant with a value for each band": scene.illuminant is None
        or len(scene.illuminant) == bands,
        "endmembers with a value for each band": all(len(row) == bands for row in scene.endmembers or ()),
        "line_rows of each training view": scene.line_rows is None
        or len(scene.line_rows) == scene.num_train_views,
        "a name for each endmember": None in (scene.material_names, scene.endmembers)
        or len(scene.material_names or ()) == len(scene.endmembers or ()),
    }
    broken = [rule for rule, holds in rules.items() if not holds]
    for sensor in values.get("sensors", ()):
        SceneSensor.from_json(sensor, bands)
    if broken:
        raise ValueError(f"the scene needs {' and '.join(broken)}")
