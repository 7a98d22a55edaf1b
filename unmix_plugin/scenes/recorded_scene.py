"""What a run folder says of its spectral scene, checked before anything relies on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeAlias

from unmix_plugin.engine.runs.config_json import config_from_json
from unmix_plugin.scenes.scene import SceneOptions
from unmix_plugin.spectral.scene_sensor import SceneSensor

Numbers: TypeAlias = tuple[float, ...]


@dataclass(frozen=True)
class RecordedFrame:
    """A `Normalisation` in JSON."""

    rotation: tuple[Numbers, Numbers, Numbers] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RecordedScene:
    """Entries of a data manager's metadata and summary; what a run lacks keeps its default."""

    wavelengths_nm: Numbers = ()
    illuminant: Numbers | None = None
    has_alpha: bool = False
    is_unbounded: bool = False
    grid_resolution: int = 64
    pixel_size: float = 1.0
    subpixels: int = 1
    num_train_views: int = 1
    num_train_pixels: int = 0
    line_rows: tuple[int, ...] | None = None
    root: str = ""
    normalisation: RecordedFrame | None = None
    material_names: tuple[str, ...] | None = None
    endmembers: tuple[Numbers, ...] | None = None
    has_labels: bool = False
    has_abundances: bool = False
    input_hashes: Mapping[str, str] = field(default_factory=dict)
    truth_hashes: Mapping[str, str] = field(default_factory=dict)
    options: SceneOptions = SceneOptions()


def check_recorded_scene(values: Mapping[str, Any]) -> None:
    """Refuse metadata or a summary that no data manager wrote.

    Raises:
        ValueError: an entry is of the wrong type, or a number out of its range.
        KeyError, IndexError, TypeError: a sensor is damaged.
        ConfigError: the same, found by `config_from_json`.
    """
    known = {entry.name: values[entry.name] for entry in fields(RecordedScene) if entry.name in values}
    scene = config_from_json(known, RecordedScene(), "the scene")
    bands = len(scene.wavelengths_nm)
    steps = zip(scene.wavelengths_nm, scene.wavelengths_nm[1:], strict=False)
    rules = {
        "wavelengths above 0 nm that increase": all(0 < low < high for low, high in steps),
        "an illuminant with a value a band, none negative": scene.illuminant is None
        or (len(scene.illuminant) == bands and min(scene.illuminant, default=0) >= 0),
        "endmembers with a value a band": all(len(row) == bands for row in scene.endmembers or ()),
        "a grid_resolution of 8 to 512": 8 <= scene.grid_resolution <= 512,
        "a pixel_size above 0": scene.pixel_size > 0,
        "subpixels of 1 to 8": 1 <= scene.subpixels <= 8,
        "num_train_views of at least 1": scene.num_train_views >= 1,
        "num_train_pixels of at least 0": scene.num_train_pixels >= 0,
        "line_rows of 0 to 65536, one a training view": scene.line_rows is None
        or (len(scene.line_rows) == scene.num_train_views and all(0 <= n <= 65536 for n in scene.line_rows)),
        "a name for each endmember": None in (scene.material_names, scene.endmembers)
        or len(scene.material_names or ()) == len(scene.endmembers or ()),
        "a rotation of 3 x 3 and a scale above 0": scene.normalisation is None
        or (scene.normalisation.scale > 0 and all(len(row) == 3 for row in scene.normalisation.rotation)),
    }
    broken = [rule for rule, holds in rules.items() if not holds]
    for sensor in values.get("sensors", ()):
        SceneSensor.from_json(sensor, bands)
    if broken:
        raise ValueError(f"the scene needs {' and '.join(broken)}")
