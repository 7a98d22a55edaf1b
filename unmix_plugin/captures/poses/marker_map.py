"""Markers and cameras in one world, and the least squares over the corners of all sightings.

Notation: `S` sightings of a marker in a view, `N` views, `M` markers, `L` lenses. Transforms are 4 x 4, `a_from_b`
takes coordinates of b to those of a; camera axes are OpenCV's here, +x right, +y down, +z forward.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Int

from unmix_plugin.captures.poses.lens import Lens

SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners of a marker in its own coordinates, over its side; +z points away from the printed side."""

Transforms: TypeAlias = Float64[np.ndarray, "*n 4 4"]


@dataclass(frozen=True)
class Seen:
    """All sightings, in the order of their views."""

    views: tuple[str, ...]
    numbers: tuple[int, ...]
    """Of the markers."""
    view: Int[np.ndarray, " S"]
    marker: Int[np.ndarray, " S"]
    corners: Float64[np.ndarray, "S 4 2"]
    """Pixels."""
    sensor: Int[np.ndarray, " N"]
    """Index of the lens of each view."""

    def part(self, keep: Bool[np.ndarray, " S"]) -> Seen:
        return replace(self, view=self.view[keep], marker=self.marker[keep], corners=self.corners[keep])


@dataclass(frozen=True)
class MarkerMap:
    """Where everything is; NaN where it is not known."""

    camera_from_world: Float64[np.ndarray, "N 4 4"]
    world_from_marker: Float64[np.ndarray, "M 4 4"]
    sizes: Float64[np.ndarray, " M"]
    """Sides of the markers, the first one's is 1."""
    lenses: tuple[Lens, ...]

    def errors(self, seen: Seen) -> Float64[np.ndarray, "S 4 2"]:
        """Pixels by which corners are missed."""
        corners = transformed(self.world_from_marker, self.sizes[:, None, None] * SQUARE)
        local = transformed(self.camera_from_world[seen.view], corners[seen.marker])
        return _pixels(local, seen, self.lenses) - seen.corners


def solve(
    found: MarkerMap,
    seen: Seen,
    free: Bool[np.ndarray, " L"],
    same_size: bool,
    loss: str = "linear",
    steps: int = 60,
    bent: bool = False,
) -> MarkerMap:
    """Least squares over the views and markers of the sightings, and over lenses that are free.

    Columns are 6 for each view and 7 for each marker (a rotation vector, a shift, the logarithm of the size) and 3 for
    each lens (the logarithm of the focal length, k1, k2); what is fixed has no column.
    """
    from scipy.optimize import least_squares
    from scipy.sparse import csr_matrix
    from scipy.spatial.transform import Rotation

    views, markers = np.unique(seen.view), np.unique(seen.marker)
    reference = markers[np.bincount(seen.marker)[markers].argmax()]  # holds the world in place
    count = (len(found.camera_from_world), len(found.world_from_marker), len(found.lenses))
    columns = [np.full((count[0], 6), -1), np.full((count[1], 7), -1), np.full((count[2], 3), -1)]
    columns[0][views] = 0
    columns[1][np.setdiff1d(markers, [reference]), : 6 if same_size else 7] = 0
    columns[2][free, : 3 if bent else 1] = 0
    total = 0
    for block in columns:
        block[block == 0] = np.arange(total, total + (block == 0).sum())
        total += int((block >= 0).sum())

    def state(values: np.ndarray) -> MarkerMap:
        """The map after steps from where it was."""
        step = [np.where(block < 0, 0.0, np.append(values, 0.0)[block]) for block in columns]
        cameras, placed = found.camera_from_world.copy(), found.world_from_marker.copy()
        for transforms, by in ((cameras, step[0]), (placed, step[1])):
            transforms[:, :3, :3] = Rotation.from_rotvec(by[:, :3]).as_matrix() @ transforms[:, :3, :3]
            transforms[:, :3, 3] += by[:, 3:6]
        lenses = tuple(
            replace(
                lens,
                focal_px=(lens.focal_px[0] * float(np.exp(by[0])), lens.focal_px[1] * float(np.exp(by[0]))),
                distortion=(
                    lens.distortion[0] + float(by[1]),
                    lens.distortion[1] + float(by[2]),
                    *lens.distortion[2:],
                ),
            )
            if is_free
            else lens
            for lens, by, is_free in zip(found.lenses, step[2], free, strict=True)
        )
        return MarkerMap(cameras, placed, found.sizes * np.exp(step[1][:, 6]), lenses)

    where = [columns[0][seen.view], columns[1][seen.marker], columns[2][seen.sensor[seen.view]]]
    column = np.concatenate(where, axis=1)[:, None].repeat(8, axis=1)
    row = np.arange(8 * len(seen.view)).reshape(-1, 8, 1).repeat(16, axis=2)
    is_free = column >= 0

    def slopes(values: np.ndarray) -> Any:
        parts = _slopes(state(values), seen, values, columns)
        return csr_matrix(
            (parts[is_free], (row[is_free], column[is_free])), shape=(8 * len(seen.view), total)
        )

    result = least_squares(
        lambda values: state(values).errors(seen).ravel(),
        np.zeros(total),
        jac=slopes,  # type: ignore[arg-type]
        loss=loss,
        x_scale="jac",
        tr_solver="lsmr",
        max_nfev=steps,
    )
    return state(result.x)


def _slopes(
    found: MarkerMap, seen: Seen, values: np.ndarray, columns: Sequence[np.ndarray]
) -> Float64[np.ndarray, "S 8 16"]:
    """Derivatives of the pixels of each sighting's corners by the columns of its view, marker and lens."""
    padded = np.append(values, 0.0)
    square = found.sizes[seen.marker, None, None] * SQUARE
    placed, camera = found.world_from_marker[seen.marker], found.camera_from_world[seen.view]
    turned = transformed(placed, square) - placed[:, None, :3, 3]
    world = turned + placed[:, None, :3, 3]
    swung = world @ camera[:, :3, :3].transpose(0, 2, 1)
    local = swung + camera[:, None, :3, 3]
    view_turn = np.where(columns[0] < 0, 0.0, padded[columns[0]])[seen.view, :3]
    marker_turn = np.where(columns[1] < 0, 0.0, padded[columns[1]])[seen.marker, :3]
    by_local, by_lens = _lens_slopes(local, seen, found.lenses)
    into_camera = camera[:, None, :3, :3]
    by_view = np.concatenate(
        [-_cross(swung) @ _left(view_turn)[:, None], np.eye(3) + 0 * _cross(swung)], axis=-1
    )
    by_marker = np.concatenate(
        [-_cross(turned) @ _left(marker_turn)[:, None], np.eye(3) + 0 * _cross(turned), turned[..., None]],
        axis=-1,
    )
    parts = [by_local @ by_view, by_local @ (into_camera @ by_marker), by_lens]
    return np.concatenate(parts, axis=-1).reshape(len(seen.view), 8, 16)


def _cross(vectors: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3 3"]:
    """Matrices that take the cross product with vectors from the left."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _left(turns: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3 3"]:
    """How rotation vectors turn further with a small step of theirs (the left Jacobian of SO(3))."""
    angle = np.linalg.norm(turns, axis=-1)[..., None, None]
    cross = _cross(turns)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + first * cross + second * cross @ cross


def _lens_slopes(
    local: Float64[np.ndarray, "S 4 3"], seen: Seen, lenses: Sequence[Lens]
) -> tuple[Float64[np.ndarray, "S 4 2 3"], Float64[np.ndarray, "S 4 2 3"]]:
    """Derivatives of pixels by the point before the camera, and by log f, k1, k2; tangential terms left out."""
    sensor = seen.sensor[seen.view]
    focal = np.array([lens.focal_px for lens in lenses])[sensor][:, None]
    radial = np.array([lens.radial for lens in lenses])[sensor]
    depth = local[..., 2:]
    ideal = local[..., :2] / depth
    squared = (ideal**2).sum(axis=-1)
    powers = squared[..., None] ** np.arange(1, 5)
    grown = 1.0 + (powers * radial[:, None]).sum(axis=-1)
    growth = (np.arange(1, 5) * squared[..., None] ** np.arange(4) * radial[:, None]).sum(axis=-1)
    by_ideal = grown[..., None, None] * np.eye(2) + 2 * growth[..., None, None] * (
        ideal[..., :, None] * ideal[..., None, :]
    )
    by_point = np.concatenate([np.eye(2) + 0 * by_ideal, -ideal[..., None]], axis=-1) / depth[..., None]
    by_lens = np.stack([ideal * grown[..., None], ideal * powers[..., :1], ideal * powers[..., 1:2]], axis=-1)
    return focal[..., None] * (by_ideal @ by_point), focal[..., None] * by_lens


def _pixels(
    local: Float64[np.ndarray, "S 4 3"], seen: Seen, lenses: Sequence[Lens]
) -> Float64[np.ndarray, "S 4 2"]:
    """Where lenses see points; points behind the camera are taken far off the picture."""
    ideal = local[..., :2] / np.maximum(local[..., 2:], 1e-3)
    pixels = np.empty_like(ideal)
    sensor = seen.sensor[seen.view]
    for index, lens in enumerate(lenses):
        pixels[sensor == index] = lens.pixels_of(ideal[sensor == index].reshape(-1, 2)).reshape(-1, 4, 2)
    return pixels


def transformed(
    transforms: Transforms, points: Float64[np.ndarray, "#*n P 3"]
) -> Float64[np.ndarray, "*n P 3"]:
    return points @ np.swapaxes(transforms[..., :3, :3], -1, -2) + transforms[..., None, :3, 3]


def rms(errors: Float64[np.ndarray, "S 4 2"]) -> Float64[np.ndarray, " S"]:
    """Root mean square distance of each sighting's corners."""
    return np.sqrt((errors**2).sum(axis=-1).mean(axis=-1))
