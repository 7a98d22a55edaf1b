"""Evaluation views aligned with what was measured of them, where training fitted the like for each of its own views.

*Gain.* A trained gain says nothing of views that were not trained on, so exposure and a smooth white balance are
fitted. Figures after it say how well a view is predicted but for these.

*Pose.* Corrected poses and field move together, so a given pose no longer says exactly from where a view was taken. One
turn and one shift are found with which the field shows it best, coarse pictures first. A view that is off by a tenth of
its width must first be brought near, by a turn alone: pictures three pixels wide are alike within a third of the width.
That is taken only where it is clearly better than what the given pose leads to: coarse pictures also move a view that
is right. The rows of a line camera wobble, so they are fitted one by one afterwards. Where gains are fitted too, each
pose that is tried has its own, so that none makes up for an exposure; rows are fitted to what was measured divided by
the gain of the means, which hardly depends on how rows wobble.

Notation: `B` bands, `b` channels of the view's sensor, `T` terms, `P` pixels of a coarse picture, `C` spectral channels
compared, `D` those and opacity.

Source: Lin et al. 2021, BARF (alignment of views at test time); here by Levenberg-Marquardt steps with central
differences of renders, since one-sided ones stop early.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import rotation_matrix
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.poses.refinement import LARGEST_STEP
from unmix_plugin.poses.row_fitting import fit_rows, main_axes
from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.sensors.views import smooth_terms
from unmix_plugin.trained.evaluation import PredictedView, ViewTruth, render_view, subpixels_for
from unmix_plugin.trained.trained_scene import MaterialView, TrainedScene

_NUM_STEPS = 20


def render_aligned(
    scene: TrainedScene, camera: Cameras, measured: Scene, index: int, truth: ViewTruth
) -> PredictedView:
    """A view as it is compared with what was measured of it: aligned as far as the scene's `fitted` says, with a rig
    in as many rays per pixel as its sensor asks for; `truth` was measured in the frame at `index`."""
    if "pose" in scene.fitted:
        align = align_rows if camera.is_line_camera(0) else align_pose
        camera = align(scene, camera, truth)
    predicted = render_view(scene, camera, subpixels_for(measured, index, scene.subpixels, scene.pixel_size))
    if "gain" in scene.fitted:
        predicted = align_gain(predicted, truth, torch.from_numpy(measured.wavelengths_nm))
    return predicted


def align_gain(
    predicted: PredictedView, truth: ViewTruth, wavelengths_nm: Float[Tensor, "B"]
) -> PredictedView:
    """The prediction with the smooth gain with which it comes nearest to the measured view."""
    counts = truth.shows_matter & ~truth.blown_out
    if not bool(counts.any()):
        return predicted
    shown, measured = truth.seen(predicted.spectra)[counts].double(), truth.spectra[counts].double()
    terms = _terms_seen(truth, wavelengths_nm)
    return replace(
        predicted, gain=_fitted_gain((shown * shown).sum(dim=0), (shown * measured).sum(dim=0), terms)
    )


def _terms_seen(truth: ViewTruth, wavelengths_nm: Float[Tensor, "B"]) -> Float64[Tensor, "T b"]:
    """Terms of smooth gains as the view's sensor sees them, as in training."""
    terms = truth.seen(smooth_terms(wavelengths_nm.double()))
    return terms / terms[:1]


def _fitted_gain(
    power: Float64[Tensor, "*views b"], agreement: Float64[Tensor, "*views b"], terms: Float64[Tensor, "T b"]
) -> Float64[Tensor, "*views b"]:
    """Smooth gain g of least squared error, by Gauss-Newton steps."""
    logs = terms.new_zeros(*power.shape[:-1], len(terms))
    # Of a prediction that is black everywhere nothing can be fitted: its gain stays 1.
    ridge = (1e-9 * power.sum(dim=-1)).clamp(min=1e-30)[..., None, None] * torch.eye(len(terms)).to(terms)
    for _ in range(_NUM_STEPS):
        gain = (logs @ terms).exp()
        slopes = (terms * (power * gain * gain)[..., None, :]) @ terms.T + ridge
        step = torch.linalg.solve(slopes, (agreement * gain - power * gain * gain) @ terms.T)
        logs = logs + step.clamp(-0.5, 0.5)
    return (logs @ terms).exp()


_SIDES_PX = (24, 48, 96, 192)
"""Longest sides of the pictures compared, one after the other; none larger than the view."""
_STEPS = (6, 3, 2, 1)
"""Most steps taken on each."""
_FIRST_STEPS = 3
"""Steps taken from each start before the best is chosen."""
_POOLED = ((8, 3), (4, 3), (2, 3), (2, 6))
"""Edges of the blocks of pixels whose means are compared before, on the smallest picture, and how many numbers of a
pose are fitted: its turn, or all."""
_POOLED_STEPS = 4
_CLEARLY_BETTER = 0.8
"""Part of the squared error to which the given pose leads, below which another is taken."""
_APART_PX = 1.0
"""How far the other start is from the given pose on the smallest picture, at least: a nearer one leads there too."""
_DAMPING = 1e-3
_TRIES = 6
"""Dampings of a step that are tried, each ten times the one before."""
_DIFFERENCE_PX = 0.5
_SMALLEST_STEP_PX = 0.05
"""Below which no further step is taken on a picture."""


@torch.no_grad()
def align_pose(scene: TrainedScene, camera: Cameras, truth: ViewTruth) -> Cameras:
    """The camera, moved to where the scene looks most like what was measured; one camera, of a frame or of lines."""
    axes = main_axes(truth.spectra[truth.valid])
    step = torch.zeros(6)
    for side, count in zip(_SIDES_PX, _STEPS, strict=True):
        if side > max(camera.width, camera.height) and side > _SIDES_PX[0]:
            break
        comparison = _Comparison.of(scene, _shrunk(camera, side), truth, axes)
        if side == _SIDES_PX[0]:
            step = _best_start(comparison)
        step = comparison.fit(step, count)
    return moved_camera(camera, step, scene)


def _best_start(comparison: _Comparison) -> Float[Tensor, "6"]:
    """A few steps from the given pose, or from where coarse pictures lead if that is clearly better."""

    near = torch.zeros(6)
    for block, num_moves in _POOLED:
        near = replace(comparison, block=block).fit(near, _POOLED_STEPS, num_moves)
    stayed = comparison.fit(torch.zeros(6), _FIRST_STEPS)
    if float(near.norm()) < _APART_PX / _DIFFERENCE_PX * comparison.difference:
        return stayed
    found = comparison.fit(near, _FIRST_STEPS)
    return found if comparison.error(found) < _CLEARLY_BETTER * comparison.error(stayed) else stayed


@dataclass(frozen=True)
class _Comparison:
    """What the field shows beside what was measured, as the camera moves."""

    scene: TrainedScene
    camera: Cameras
    truth: ViewTruth
    axes: Float[Tensor, "b C"]
    """In which differences of spectra are compared."""
    wanted: Float[Tensor, "P D"]
    """Along the axes, but all channels where a gain is fitted; then opacity."""
    counts: Float[Tensor, "P 1"]
    """Share of each pixel that counts."""
    exposed: Float[Tensor, "P 1"]
    """Share that counts and isn't blown out: a gain is fitted to it."""
    terms: Float64[Tensor, "T b"] | None
    """Of a gain that is fitted anew to each picture, so that no pose makes up for an exposure; None: no gain."""
    block: int = 1
    """Edge of the blocks of pixels whose means are compared."""

    @classmethod
    def of(
        cls, scene: TrainedScene, camera: Cameras, truth: ViewTruth, axes: Float[Tensor, "b C"]
    ) -> _Comparison:
        """In as many pixels as the camera has."""
        alpha = truth.opacity.float()[..., None]
        terms = _terms_seen(truth, torch.tensor(scene.bands.centers_nm)) if "gain" in scene.fitted else None
        spectra = truth.spectra.float() if terms is not None else truth.spectra.float() @ axes
        values = torch.cat([spectra, alpha], dim=-1) * truth.valid[..., None]
        masks = torch.stack([truth.valid, truth.valid & ~truth.blown_out], dim=-1).float()
        both = torch.cat([values, masks], dim=-1).permute(2, 0, 1)[None]
        size = (camera.height, camera.width)
        found = torch.nn.functional.adaptive_avg_pool2d(both, size)[0].flatten(1).T
        counts, exposed = found[:, -2:-1], found[:, -1:]
        wanted = found[:, :-2] / counts.clamp(min=1e-6)
        return cls(scene, camera, truth, axes, wanted, counts, exposed, terms)

    @property
    def difference(self) -> float:
        """A turn that moves the picture by half a pixel, in radians."""
        return _DIFFERENCE_PX / float(self.camera.focal_px.mean())

    def fit(self, start: Float[Tensor, "6"], count: int, num_moves: int = 6) -> Float[Tensor, "6"]:
        """Levenberg-Marquardt steps from `start` that each lower the sum of squares, within `LARGEST_STEP`, in the
        first numbers of a pose."""
        best, found = start, self.residuals(start[None])[0]
        axes = self.difference * torch.eye(6)[:num_moves]
        damping = _DAMPING
        for _ in range(count):
            ahead, behind = self.residuals(best + torch.cat([axes, -axes])).double().chunk(2)
            slopes = (ahead - behind).T / (2 * self.difference)
            normal, pull = slopes.T @ slopes, slopes.T @ found.double()
            for _ in range(_TRIES):
                ridge = damping * normal.diagonal().mean().clamp(min=1e-12) * torch.eye(num_moves).double()
                tried = best - torch.linalg.solve(normal + ridge, pull).float() @ torch.eye(6)[:num_moves]
                tried = tried.clamp(-LARGEST_STEP, LARGEST_STEP)
                seen = self.residuals(tried[None])[0]
                if float(seen.square().sum()) < float(found.square().sum()):
                    change = float((tried - best).norm()) / self.difference * _DIFFERENCE_PX
                    best, found, damping = tried, seen, damping / 3
                    if change < _SMALLEST_STEP_PX:
                        return best
                    break
                damping *= 10
            else:
                return best
        return best

    def residuals(self, steps: Float[Tensor, "m 6"]) -> Float[Tensor, "m n"]:
        """Shown less measured, of each pixel or block and channel, after each step."""
        seen = self._shown(steps)
        if self.terms is None:
            return self._blocks((seen - self.wanted) * self.counts).flatten(1)
        gains = self._gains(seen)[:, None].to(seen)
        seen, wanted = self._blocks(seen * self.counts), self._blocks((self.wanted * self.counts)[None])
        spectra = (seen[..., :-1] * gains - wanted[..., :-1]) @ self.axes
        return torch.cat([spectra, seen[..., -1:] - wanted[..., -1:]], dim=-1).flatten(1)

    def mean_gain(self) -> Float64[Tensor, "b"] | None:
        """With which the mean of what is shown comes nearest to that of what was measured, however rows are shifted;
        None where no gain is fitted."""
        if self.terms is None:
            return None
        whole = replace(self, block=2 * max(self.camera.width, self.camera.height))
        return whole._gains(self._shown(torch.zeros(1, 6)))[0]

    def _gains(self, seen: Float[Tensor, "m P D"]) -> Float64[Tensor, "m b"]:
        """Of each picture, by what is not blown out."""
        assert self.terms is not None
        shown, measured = (
            self._blocks(values[..., :-1] * self.exposed).double() for values in (seen, self.wanted[None])
        )
        power, agreement = ((shown * other).sum(dim=1) for other in (shown, measured))
        return _fitted_gain(power, agreement, self.terms)

    def _shown(self, steps: Float[Tensor, "m 6"]) -> Float[Tensor, "m P D"]:
        """What the camera sees after each step: pictures rendered as one; all channels where a gain is fitted."""
        is_coarse = self.block == 1 and max(self.camera.width, self.camera.height) <= _SIDES_PX[0]
        subpixels = 2 if is_coarse else 1
        height, width = subpixels * self.camera.height, subpixels * self.camera.width
        cameras = [moved_camera(self.camera, step, self.scene) for step in steps]
        rays = [camera.resized(width, height).to(self.scene.device).image_rays(0) for camera in cameras]
        found = composite(self.scene.renderer, self.scene.field, RayBundle.join(rays))
        view = MaterialView(self.scene, cameras[0], found.unflatten(len(cameras) * height, width))
        opacity = view.opacity if self.truth.alpha is not None else torch.ones_like(view.opacity)
        seen = self.truth.seen(view["spectral"]).float()
        seen = seen if self.terms is not None else seen @ self.axes.to(view.opacity)
        values = torch.cat([seen, opacity[..., None]], dim=-1).unflatten(0, (len(cameras), height))
        return torch.nn.functional.avg_pool2d(values.permute(0, 3, 1, 2), subpixels).flatten(2).mT.cpu()

    def _blocks(self, pixels: Float[Tensor, "m P x"]) -> Float[Tensor, "m n x"]:
        """Means over blocks of pixels."""
        if self.block == 1:
            return pixels
        rows = pixels.unflatten(1, (self.camera.height, self.camera.width)).permute(0, 3, 1, 2)
        height, width = (max(1, round(edge / self.block)) for edge in rows.shape[2:])
        return torch.nn.functional.adaptive_avg_pool2d(rows, (height, width)).flatten(2).mT

    def error(self, step: Float[Tensor, "6"]) -> float:
        """Sum of the squares."""
        return float(self.residuals(step[None]).square().sum())


def moved_camera(camera: Cameras, step: Float[Tensor, "6"], scene: TrainedScene) -> Cameras:
    """A camera that is turned about itself and shifted, by a share of its distance to the scene's middle."""
    middle = scene.scene_box.aabb.mean(dim=0).to(camera.camera_to_world)
    reach = (camera.camera_to_world[0, :, 3] - middle).norm()
    turn, shift = rotation_matrix(step[:3]).to(middle), (step[3:].to(middle) * reach)[:, None]

    def change(poses: Float[Tensor, "n 3 4"]) -> Float[Tensor, "n 3 4"]:
        return torch.cat([turn @ poses[:, :, :3], poses[:, :, 3:] + shift], dim=-1)

    keys = camera.key_poses
    return replace(
        camera,
        camera_to_world=change(camera.camera_to_world),
        key_poses=None if keys is None else replace(keys, poses=change(keys.poses)),
    )


def _shrunk(camera: Cameras, side: int) -> Cameras:
    """The same view in fewer pixels; both edges shrink by about as much."""
    share = min(1.0, side / max(camera.width, camera.height))
    width, height = max(1, round(share * camera.width)), max(1, round(share * camera.height))
    scale = camera.focal_px.new_tensor([width / camera.width, height / camera.height])
    keys = camera.key_poses
    return replace(
        camera,
        focal_px=camera.focal_px * scale,
        center_px=camera.center_px * scale,
        width=width,
        height=height,
        key_poses=None if keys is None else replace(keys, heights=keys.heights * scale[1]),
    )


@torch.no_grad()
def align_rows(scene: TrainedScene, camera: Cameras, truth: ViewTruth) -> Cameras:
    """A line camera, its rows moved to where the scene looks most like what was measured."""

    def look(rays: RayBundle, axes: Float[Tensor, "b C"]) -> Float[Tensor, "R D"]:
        matrix = axes if truth.sensor is None else torch.from_numpy(truth.sensor.matrix).to(axes).T @ axes
        found = composite(scene.renderer, scene.field, rays)
        seen = scene.materials.through(found, matrix)
        return seen if truth.alpha is None else torch.cat([seen, found.accumulation[:, None]], dim=1)

    turned = align_pose(scene, camera, truth)
    small, axes = _shrunk(turned, _SIDES_PX[-1]), main_axes(truth.spectra[truth.valid])
    gain = _Comparison.of(scene, small, truth, axes).mean_gain()
    spectra = truth.spectra if gain is None else truth.spectra / gain.to(truth.spectra)
    return fit_rows(turned.to(scene.device), spectra, truth.valid, truth.alpha, scene.scene_box, look)
