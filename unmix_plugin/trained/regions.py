"""Named parts of a scene's surface: a box of the world, a material, or what a view shows inside a mask.

Notation: `H x W` pixels.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import msgspec
import numpy as np
from jaxtyping import Bool
from msgspec import Meta

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import NOT_PORTABLE, safe_name

MOST_REGIONS = 256
"""That are kept with a run."""
_LONGEST_NAME = 64
_MOST_PIXELS = 1 << 26


@dataclass(frozen=True)
class Box:
    """What lies in a box of the world."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        if not all(a < b for a, b in zip(self.low, self.high, strict=True)):
            raise ConfigError(
                f"the box from {self.low} to {self.high} has no volume; give two opposite corners"
            )


@dataclass(frozen=True)
class OfMaterial:
    """Where segmentations show a material."""

    material: int
    """Number of its endmember."""


@dataclass(frozen=True, eq=False)
class InView:
    """What a camera sees in some of its pixels, and nothing that is hidden behind it."""

    camera: Cameras
    """One camera, model space."""
    runs: Sequence[int]
    """Of pixels outside and inside in turn, row after row, the first outside; in all as many as the view has."""

    @classmethod
    def of_mask(cls, camera: Cameras, mask: Bool[np.ndarray, "H W"]) -> InView:
        """Where a mask of the camera's size is true."""
        flat = mask.reshape(-1)
        ends = np.flatnonzero(np.diff(flat)) + 1
        lengths = np.diff(np.concatenate([[0], ends, [flat.size]]))
        return cls(camera, [*([0] if flat[0] else []), *lengths.tolist()])

    def mask(self) -> Bool[np.ndarray, "H W"]:
        """Which pixels; made anew at each call, as many regions of large views would not fit into memory."""
        inside = np.arange(len(self.runs)) % 2 == 1
        return np.repeat(inside, self.runs).reshape(self.camera.height, self.camera.width)


Region: TypeAlias = Box | OfMaterial | InView


def check_name(name: str, others: Iterable[str] = ()) -> str:
    """A name for a region, without spaces around it; a ConfigError where it can't be one.

    It has to be fit for files, beside those of `others` on any system (the same name may be among them), and for
    tables, which take some for a formula.
    """
    name, refused = unicodedata.normalize("NFC", name.strip()), "can't be the name of a region"
    is_safe = 0 < len(name) <= _LONGEST_NAME and name == safe_name(name, NOT_PORTABLE)
    if not is_safe or "," in name or name[0] in "=+-@":
        raise ConfigError(
            f"{name[:80]!r} {refused}; expected a name that a file can have on every system: 1 to {_LONGEST_NAME} "
            "letters, digits, spaces, - or _, the first a letter or digit"
        )
    for other in others:
        if other != name and other.casefold() == name.casefold():
            raise ConfigError(
                f"{name!r} {refused}: {other!r} is one, and files of both are one on some systems"
            )
    if name.startswith("material "):
        raise ConfigError(f"{name!r} {refused}: exports name areas of materials so; choose another beginning")
    return name


def polygon_mask(corners: Sequence[tuple[float, float]], size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Pixels of an image of this width and height whose centres lie inside a polygon of 3 corners or more (x, y from
    the top left corner); a ConfigError where there are none."""
    from skimage.draw import polygon2mask

    if len(corners) < 3:
        raise ConfigError(f"a polygon has 3 corners or more; found {len(corners)}")
    # Rows and columns; the centre of the first pixel is at 0 there and at 0.5 here.
    mask = polygon2mask(size[::-1], [(y - 0.5, x - 0.5) for x, y in corners])
    if not mask.any():
        raise ConfigError("the polygon has no pixel of the view in it")
    return mask.astype(bool)


def region_to_json(region: Region) -> dict[str, Any]:
    """Numbers and lists; `read_region` restores the same region."""
    if isinstance(region, Box):
        return {"kind": "box", "low": list(region.low), "high": list(region.high)}
    if isinstance(region, OfMaterial):
        return {"kind": "material", "material": region.material}
    return {"kind": "view", "camera": region.camera.to_json(), "runs": list(region.runs)}


class _WrittenBox(msgspec.Struct, tag="box", tag_field="kind"):
    low: tuple[float, float, float]
    high: tuple[float, float, float]


class _WrittenMaterial(msgspec.Struct, tag="material", tag_field="kind"):
    material: Annotated[int, Meta(ge=0)]


class _WrittenView(msgspec.Struct, tag="view", tag_field="kind"):
    camera: dict[str, Any]
    runs: list[Annotated[int, Meta(ge=0)]]


WrittenRegion: TypeAlias = _WrittenBox | _WrittenMaterial | _WrittenView
"""What `region_to_json` writes."""


def read_region(written: WrittenRegion) -> Region:
    """The region that `region_to_json` wrote. Raises ConfigError: a box without a volume. Raises ValueError,
    RuntimeError: a camera that is none, or pixels that are not those of its view."""
    if isinstance(written, _WrittenBox):
        return Box(written.low, written.high)
    if isinstance(written, _WrittenMaterial):
        return OfMaterial(written.material)
    camera, runs = Cameras.from_json(written.camera), written.runs
    pixels = camera.width * camera.height
    if len(camera) != 1 or pixels > _MOST_PIXELS:
        raise ValueError(f"a view of {len(camera)} cameras with {pixels} pixels")
    if sum(runs) != pixels:
        raise ValueError(f"runs of {sum(runs)} pixels in a view of {pixels}")
    return InView(camera, runs)
