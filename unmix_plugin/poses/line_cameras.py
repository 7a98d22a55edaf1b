"""Line cameras of a training, registered to its scene from time to time.

Of each view some columns are kept, in the few channels in which its spectra vary most.

Notation: `H` rows, `W` columns, `B` bands of the scene, `b` channels of a sensor, `D` channels compared, `R` rays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.engine.data_manager import DataManager
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.poses.line_registration.register import register
from unmix_plugin.poses.line_registration.swept_view import Show, SweptView, columns_compared, rays_through
from unmix_plugin.poses.refinement import PoseRefinement
from unmix_plugin.spectral.materials import Coefficients, Materials

MOST_PIXELS = 150_000
"""Compared, of all views together."""
_CHANNELS = 3


@dataclass(frozen=True)
class Swept:
    """What is kept of a view of a line camera."""

    camera: Cameras
    """As it was given; one camera."""
    columns: Int[Tensor, " W"]
    """Of its image."""
    index: int
    """Among the training views."""
    sensor: int | None
    """Of a rig, what took it."""
    wanted: Float[Tensor, "H W D"]
    counts: Float[Tensor, "H W 1"]
    axes: Float[Tensor, "b C"]
    """Channels in which spectra vary most."""
    has_opacity: bool


ThroughSensor = Callable[[Swept], Float[Tensor, "B C"]]
"""From a spectrum on the scene's bands to the channels compared, as the view's sensor would have measured it now."""


class LineCameras:
    """Those among the training views."""

    def __init__(self, rows: Sequence[int]) -> None:
        """`rows` as `Knots` has them."""
        self.views = [view for view, count in enumerate(rows) if count > 0]
        self._kept: list[Swept] = []

    @torch.no_grad()
    def register(
        self,
        poses: PoseRefinement,
        data: DataManager,
        box: SceneBox,
        composite: Callable[[RayBundle], Coefficients],
        materials: Materials,
        through: ThroughSensor,
    ) -> None:
        """Correct the poses of all rows so that the scene looks most like what was measured.

        Args:
            poses: What is corrected.
            data: Has the views.
            box: Of the scene.
            composite: Renders rays.
            materials: Of the scene.
            through: See `ThroughSensor`.
        """
        self._kept = self._kept or [self._keep(view, data) for view in self.views]
        views = []
        for kept in self._kept:
            show = shower(composite, materials, through(kept), has_opacity=kept.has_opacity)
            views.append(swept_view(kept, poses.lens.of(kept.camera).to(data.device), box, show))
        steps = [
            poses.steps_of(kept.index, view.distance) for kept, view in zip(self._kept, views, strict=True)
        ]
        for kept, view, found in zip(self._kept, views, register(views, steps), strict=True):
            poses.take_registered(kept.index, found, view.distance)

    def _keep(self, view: int, data: DataManager) -> Swept:
        camera = data.train_cameras[view]
        columns = columns_compared(*camera.size(0), MOST_PIXELS // len(self.views))
        measured = data.measured_in(view, columns)
        sensor = int(measured["sensor"]) if "sensor" in measured else None
        return keep(
            camera, columns, measured["spectra"], measured["valid"], measured.get("alpha"), sensor, view
        )


def keep(
    camera: Cameras,
    columns: Int[Tensor, " W"],
    spectra: Float[Tensor, "H W b"],
    valid: Bool[Tensor, "H W"],
    alpha: Float[Tensor, "H W"] | None,
    sensor: int | None = None,
    index: int = 0,
) -> Swept:
    """What is kept of one line camera's image, of which some columns are given."""
    axes = main_axes(spectra[valid])
    counts = valid.float()[..., None]
    values = [spectra.float() @ axes] + ([] if alpha is None else [alpha.float()[..., None]])
    wanted = (torch.cat(values, dim=-1) * counts).cpu()
    return Swept(camera, columns, index, sensor, wanted, counts.cpu(), axes, alpha is not None)


def main_axes(spectra: Float[Tensor, "P b"]) -> Float[Tensor, "b C"]:
    """The few directions in which spectra vary most; without spectra, some bands."""
    if len(spectra) == 0:
        return torch.eye(spectra.shape[1], min(_CHANNELS, spectra.shape[1]), device=spectra.device)
    some = spectra[:: max(1, len(spectra) // 20_000)].float()
    _, _, axes = torch.linalg.svd(some, full_matrices=False)
    return axes[:_CHANNELS].T


def shower(
    composite: Callable[[RayBundle], Coefficients],
    materials: Materials,
    matrix: Float[Tensor, "B C"],
    *,
    has_opacity: bool,
) -> Show:
    """What a scene shows along rays."""

    def show(rays: RayBundle) -> Float[Tensor, "R D"]:
        found = composite(rays)
        values = [materials.through(found, matrix)] + ([found.accumulation[:, None]] if has_opacity else [])
        return torch.cat(values, dim=1).cpu()

    return show


def swept_view(kept: Swept, camera: Cameras, box: SceneBox, show: Show) -> SweptView:
    """A view beside the scene as it is now, from a camera on the scene's device, from which steps start."""
    rays = rays_through(camera, 0, kept.columns)
    assert rays.image_y is not None
    distances = (rays.origins - box.aabb.mean(dim=0).to(rays.origins)).norm(dim=1)
    return SweptView(
        rays,
        kept.wanted,
        kept.counts,
        rays.image_y[:: kept.wanted.shape[1]].cpu(),
        camera.size(0)[1],
        max(float(distances.mean()), 1e-6),
        1 / float(camera.focal_px[0, 0]),
        show,
        kept.has_opacity,
    )
