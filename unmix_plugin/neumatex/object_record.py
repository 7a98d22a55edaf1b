"""What gives a model of an object its shape: `metadata` of its data manager, checked when a run is opened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from unmix_plugin.engine.runs.config_json import config_from_json
from unmix_plugin.neumatex.tone.curves import ToneMapping
from unmix_plugin.spectral.bands import Bands

if TYPE_CHECKING:
    from unmix_plugin.neumatex.scene.object_scene import ObjectScene


@dataclass(frozen=True)
class ObjectRecord:
    """Sizes of an object's buffers, and what does not fit in them."""

    num_vertices: int = 3
    num_faces: int = 1
    has_uv: bool = False
    environment_size: tuple[int, int] = (1, 2)
    """Rows and columns."""
    num_light_colours: int = 3
    rotation_deg: float = 0.0
    """Of the environment about +z."""
    exposure_stops: float = 0.0
    """Of the environment."""
    num_colours: int = 3
    """Of the pictures."""
    tone_mapping: ToneMapping = "linear"
    """What the pictures' numbers are of light."""
    wavelengths_nm: tuple[float, ...] = ()
    """Of spectral pictures; empty for RGB."""
    lamp: tuple[float, ...] = ()
    """Relative power of the light of spectral pictures, greatest band 1; empty for RGB."""

    @property
    def is_spectral(self) -> bool:
        """Whether the pictures have bands, not colours."""
        return bool(self.lamp)

    @property
    def bands(self) -> Bands | None:
        """Of spectral pictures."""
        return Bands.of(self.wavelengths_nm) if self.is_spectral else None

    @staticmethod
    def of(scene: ObjectScene) -> ObjectRecord:
        """The record of an object."""
        mesh, light = scene.mesh, scene.environment
        height, width, light_colours = light.image.shape
        return ObjectRecord(
            num_vertices=len(mesh.vertices),
            num_faces=len(mesh.faces),
            has_uv=mesh.uv is not None,
            environment_size=(height, width),
            num_light_colours=light_colours,
            rotation_deg=light.rotation_deg,
            exposure_stops=light.exposure_stops,
            num_colours=scene.pictures.num_colours,
            tone_mapping=scene.pictures.tone,
            wavelengths_nm=() if scene.bands is None else tuple(scene.bands.centers_nm.tolist()),
            lamp=() if scene.lamp is None else tuple(scene.lamp.tolist()),
        )

    def to_json(self) -> dict[str, Any]:
        """As JSON-able values."""
        values = asdict(self)
        lists = {name: list(value) for name, value in values.items() if isinstance(value, tuple)}
        return {**values, **lists}

    @staticmethod
    def from_json(values: Mapping[str, Any]) -> ObjectRecord:
        """What `to_json` wrote.

        Raises:
            ConfigError, ValueError: a value is of the wrong type or out of its range.
        """
        record = config_from_json(dict(values), ObjectRecord(), "the object")
        counts = (record.num_vertices, record.num_faces, *record.environment_size, record.num_colours)
        if min(counts) < 1 or record.num_light_colours < 1:
            raise ValueError(f"an object needs sizes of at least 1; found {counts}")
        if record.is_spectral and {len(record.lamp), len(record.wavelengths_nm)} != {record.num_colours}:
            raise ValueError(
                f"an object of {record.num_colours} bands needs as many wavelengths and powers of its lamp; found "
                f"{len(record.wavelengths_nm)} and {len(record.lamp)}"
            )
        return record
