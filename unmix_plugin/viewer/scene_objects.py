"""Objects of the browser's own beside the picture: cameras with their images, the scene box, a point cloud, probes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float, UInt8

from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.viewer.view_cameras import pose_of

if TYPE_CHECKING:
    import viser

_LARGEST_FRUSTUM = 0.12
_FRUSTUM_SHARE = 0.3
"""Size of a frustum in the distance to its nearest neighbour, so that frusta do not cover each other."""
_POINT_SIZE = 0.012
_MOST_POINTS = 20_000
_PROBE_RADIUS = 0.015
_TRAIN_COLOUR, _EVAL_COLOUR = (40, 120, 200), (220, 120, 30)

Thumbnail = UInt8[np.ndarray, "H W 3"]


def add_cameras(
    client: viser.ClientHandle,
    views: list[RunView],
    num_train: int,
    thumbnails: Mapping[str, Thumbnail | None],
) -> list[viser.CameraFrustumHandle]:
    """One frustum a view, with its image where there is one; the first `num_train` are training views."""
    handles, size = [], _frustum_size(views)
    for index, view in enumerate(views):
        pose = pose_of(view.camera)
        handles.append(
            client.scene.add_camera_frustum(
                f"/cameras/{index:04d}",
                fov=pose.fov,
                aspect=pose.aspect,
                scale=size,
                color=_TRAIN_COLOUR if index < num_train else _EVAL_COLOUR,
                image=thumbnails.get(view.name),
                wxyz=pose.wxyz,
                position=pose.position,
            )
        )
    return handles


def _frustum_size(views: list[RunView]) -> float:
    places = torch.cat([view.camera.camera_to_world[:, :, 3] for view in views]).cpu()
    if len(places) < 2:
        return _LARGEST_FRUSTUM
    nearest = torch.cdist(places, places).fill_diagonal_(torch.inf).min(dim=1).values
    return min(_LARGEST_FRUSTUM, max(_FRUSTUM_SHARE * float(nearest.median()), 1e-3))


def add_box(client: viser.ClientHandle, box: SceneBox) -> viser.LineSegmentsHandle:
    """The twelve edges of the scene box."""
    low, high = box.aabb.cpu().numpy()
    corners = np.array([[(low, high)[(i >> axis) & 1][axis] for axis in range(3)] for i in range(8)])
    edges = [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i & 1 << axis]
    points = np.array([[corners[start], corners[end]] for start, end in edges], dtype=np.float32)
    return client.scene.add_line_segments("/box", points, colors=(120, 120, 120))


def add_points(
    client: viser.ClientHandle, points: Float[torch.Tensor, "N 3"], colours: UInt8[np.ndarray, "N 3"]
) -> viser.PointCloudHandle:
    """A cloud of surface points; every n-th where there are too many."""
    step = max(1, -(-len(points) // _MOST_POINTS))
    return client.scene.add_point_cloud(
        "/points", points[::step].cpu().numpy(), colours[::step], point_size=_POINT_SIZE
    )


def add_probe(
    client: viser.ClientHandle, number: int, point: tuple[float, float, float], colour: tuple[int, int, int]
) -> viser.IcosphereHandle:
    """A small ball where a probe was taken."""
    return client.scene.add_icosphere(f"/probes/{number}", _PROBE_RADIUS, color=colour, position=point)
