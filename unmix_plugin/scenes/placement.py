"""How a scene was turned, moved and scaled: from where its poses come from to transforms.json, and on to model space.

nerfstudio's keys `applied_transform` (3 x 4) and `applied_scale`, and `offset` for coordinates that are too large for
float32, record the first: p_scene = applied_scale * applied_transform @ (p_source - offset, 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeAlias

import msgspec
import numpy as np
from jaxtyping import Float, Float64

from unmix_plugin.formats.json_values import describe, read_keys, read_numbers
from unmix_plugin.scenes.folder import WorldKeys
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.reading.faults import Faults

_ROTATION_TOLERANCE = 1e-5
"""Largest element of R^T R - 1 that passes as rounding of printed digits."""
_OTHER_OFFSETS = ("aabb", "aabb_scale", "from_na", "render_aabb", "scale")
"""Keys of instant-ngp and NeuS2, whose `offset` leads into a unit cube for rendering and moves no pose."""


@dataclass(frozen=True)
class _Similarity:
    """p_to = scale * (rotation @ (p_from - offset) + translation)."""

    rotation: Float64[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """Orthonormal, determinant 1."""
    translation: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Units that it starts from, added after the rotation."""
    scale: float = 1.0
    """Units that it leads to, for each that it starts from; > 0."""
    offset: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Subtracted first, so that geo-referenced coordinates keep their digits."""

    def _apply(self, points: Float[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        return self.scale * ((points - self.offset) @ self.rotation.T + self.translation)

    def _undo(self, points: Float[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        return (points / self.scale - self.translation) @ self.rotation + self.offset

    def moved(self, poses: Float64[np.ndarray, "*n 3 4"]) -> Float64[np.ndarray, "*n 3 4"]:
        """Poses, camera to world, in the space that it leads to."""
        positions = self._apply(poses[..., 3])
        return np.concatenate([self.rotation @ poses[..., :3], positions[..., None]], axis=-1)


_Triple: TypeAlias = tuple[float, float, float]


class _WrittenSimilarity(msgspec.Struct):
    """What `Normalisation.to_json` writes."""

    rotation: tuple[_Triple, _Triple, _Triple]
    translation: _Triple
    scale: float
    offset: _Triple = (0.0, 0.0, 0.0)


class Placement(_Similarity):
    """Similarity from the source's world to that of transforms.json."""

    def to_scene(self, points: Float[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        """Points of the source in the scene."""
        return self._apply(points)

    def to_source(self, points: Float[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        """Points of the scene in the source, the inverse of `to_scene`."""
        return self._undo(points)

    @property
    def is_identity(self) -> bool:
        """Whether it changes nothing."""
        moves = self.translation.any() or self.offset.any()
        return not moves and self.scale == 1.0 and np.array_equal(self.rotation, np.eye(3))

    def to_json(self) -> dict[str, Any]:
        """Keys of transforms.json; `read_placement` restores the same value."""
        return {
            "applied_transform": np.column_stack([self.rotation, self.translation]).tolist(),
            "applied_scale": self.scale,
            "offset": self.offset.tolist(),
        }


class Normalisation(_Similarity):
    """Similarity from world to model space."""

    def to_model(self, points: Float[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        """World points in model space."""
        return self._apply(points)

    def to_world(self, points: Float[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        """Model points in world space, the inverse of `to_model`."""
        return self._undo(points)

    def after(self, placement: Placement) -> Normalisation:
        """From the source's world to model space, where this one starts from the space of transforms.json."""
        return Normalisation(
            self.rotation @ placement.rotation,
            self.rotation @ placement.translation + self.translation / placement.scale,
            self.scale * placement.scale,
            placement.offset,
        )

    def to_json(self) -> dict[str, Any]:
        """Numbers and lists; `from_json` restores the same bits."""
        return {
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "scale": self.scale,
            **({"offset": self.offset.tolist()} if self.offset.any() else {}),
        }

    @staticmethod
    def from_json(values: Any) -> Normalisation:
        """The transform that `to_json` wrote. Raises ValueError: a part is missing or of another shape."""
        found = msgspec.convert(values, _WrittenSimilarity)
        return Normalisation(
            np.array(found.rotation), np.array(found.translation), found.scale, np.array(found.offset)
        )


def read_placement(scene: Mapping[str, Any], where: str, faults: Faults) -> tuple[Placement, float | None]:
    """What transforms.json records of its world: how the poses were moved, the identity where it records nothing; and
    the metres in a unit of the source's world. Noted faults where one is wrong.

    `offset` counts beside one of the other two only, and not in files of instant-ngp, where it means something else.
    """
    keys = read_keys(scene, WorldKeys, partial(faults.note, where, Message.WRONG_VALUE))
    given = keys.applied_transform
    rows = given[:3] if isinstance(given, list) and given[3:] == [[0, 0, 0, 1]] else given
    transform = np.eye(3, 4) if given is None else read_numbers(rows, 3, 4)
    is_rotation = False
    if transform is not None:
        rotation = transform[:, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            is_rotation = bool(np.abs(rotation.T @ rotation - np.eye(3)).max() <= _ROTATION_TOLERANCE)
        is_rotation = is_rotation and float(np.linalg.det(rotation)) > 0
    if transform is None or not is_rotation:
        faults.note(where, Message.WRONG_TRANSFORM, found=describe(given))
        transform = np.eye(3, 4)
    is_ours = any(scene.get(key) is not None for key in ("applied_transform", "applied_scale"))
    offset = keys.offset if is_ours and not any(key in scene for key in _OTHER_OFFSETS) else None
    shift = np.zeros(3) if offset is None else read_numbers(offset, 3)
    if shift is None:
        faults.note(where, Message.WRONG_OFFSET, found=describe(offset))
        shift = np.zeros(3)
    scale = 1.0 if keys.applied_scale is None else keys.applied_scale
    return Placement(transform[:, :3], transform[:, 3], scale, shift), keys.metres_per_unit
