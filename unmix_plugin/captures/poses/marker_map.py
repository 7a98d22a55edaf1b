"""Markers and cameras in one world, and the least squares over the corners of all sightings.

Notation: `S` sightings of a marker in a view, `N` views, `M` markers, `L` lenses. Transforms are 4 x 4, `a_from_b`
takes coordinates of b to those of a; camera axes are OpenCV's here, +x right, +y down, +z forward.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

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
        """Some of the sightings."""
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
        """Pixels by which corners are missed; points behind a camera are taken far off its picture."""
        corners = transformed(self.world_from_marker, self.sizes[:, None, None] * SQUARE)
        local = transformed(self.camera_from_world[seen.view], corners[seen.marker])
        ideal, pixels = local[..., :2] / np.maximum(local[..., 2:], 1e-3), np.empty(local[..., :2].shape)
        for index, lens in enumerate(self.lenses):
            of_sensor = seen.sensor[seen.view] == index
            pixels[of_sensor] = lens.pixels_of(ideal[of_sensor].reshape(-1, 2)).reshape(-1, 4, 2)
        return pixels - seen.corners

    def misses(self, seen: Seen) -> Float64[np.ndarray, " S"]:
        """Root mean square distance of each sighting's corners; infinite where its view or marker is not known."""
        squares = (self.errors(seen) ** 2).sum(axis=-1).mean(axis=-1)
        return np.sqrt(np.nan_to_num(squares, nan=np.inf))


def solve(
    found: MarkerMap,
    seen: Seen,
    free: Bool[np.ndarray, " L"],
    same_size: bool,
    loss: str = "linear",
    steps: int = 60,
    with_distortion: bool = False,
) -> MarkerMap:
    """Least squares over the views and markers of the sightings, and over lenses that are free: 6 columns for each view
    and 7 for each marker (a rotation vector, a shift, the logarithm of the size), 3 for each lens (the logarithm of the
    focal length, k1, k2); what is fixed has none."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_matrix
    from scipy.spatial.transform import Rotation

    views, markers = np.unique(seen.view), np.unique(seen.marker)
    reference = markers[np.bincount(seen.marker)[markers].argmax()]  # holds the world in place
    count = (len(found.camera_from_world), len(found.world_from_marker), len(found.lenses))
    columns = [np.full((count[0], 6), -1), np.full((count[1], 7), -1), np.full((count[2], 3), -1)]
    columns[0][views] = 0
    columns[1][np.setdiff1d(markers, [reference]), : 6 if same_size else 7] = 0
    columns[2][free, : 3 if with_distortion else 1] = 0
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
        lenses = list(found.lenses)
        for index in np.flatnonzero(free):
            lens, (zoom, k1, k2) = lenses[index], step[2][index].tolist()
            x, y = (focal * float(np.exp(zoom)) for focal in lens.focal_px)
            distortion = (lens.distortion[0] + k1, lens.distortion[1] + k2, *lens.distortion[2:])
            lenses[index] = replace(lens, focal_px=(x, y), distortion=distortion)
        return MarkerMap(cameras, placed, found.sizes * np.exp(step[1][:, 6]), tuple(lenses))

    where = [columns[0][seen.view], columns[1][seen.marker], columns[2][seen.sensor[seen.view]]]
    column = np.concatenate(where, axis=1)[:, None].repeat(8, axis=1)
    row = np.arange(8 * len(seen.view)).reshape(-1, 8, 1).repeat(16, axis=2)
    acts = column >= 0  # a sighting's corners move with its view, marker and lens alone
    pattern = csr_matrix((np.ones(acts.sum()), (row[acts], column[acts])), shape=(8 * len(seen.view), total))
    result = least_squares(
        lambda values: state(values).errors(seen).ravel(),
        np.zeros(total),
        jac_sparsity=pattern,
        loss=loss,
        x_scale="jac",
        tr_solver="lsmr",
        max_nfev=steps,
    )
    return state(result.x)


def transformed(
    transforms: Transforms, points: Float64[np.ndarray, "#*n P 3"]
) -> Float64[np.ndarray, "*n P 3"]:
    """Points in the coordinates that transforms lead to."""
    return points @ np.swapaxes(transforms[..., :3, :3], -1, -2) + transforms[..., None, :3, 3]
