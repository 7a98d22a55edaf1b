"""Rows of a line camera, moved until a scene looks like what they measured; the scene is held meanwhile.

A step (w, m) turns a row's camera by the rotation vector w about itself, in the scene's axes, and moves it by m times
its distance to the scene's middle. Steps stand at the knots of a cubic spline (knots.py) and are found by
Levenberg-Marquardt steps on all pixels of the view. All rows are moved by the same small amount for each of the six
numbers of a step, so twelve renders tell how each row changes with its own pose. Pixels that fit far worse than others
pull less (Huber). What carries a line camera moves smoothly: the second difference between knots is small (`_BEND_PX`),
so what no row tells of goes on straight, and the first difference is not large (`_DRIFT_PX`), so it does not go far.

Notation: `H` rows and `W` columns that are compared, `b` channels of the camera, `D` channels that are compared, `m`
ways to move the rows, `n` knots, `R` rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses, rotation_matrix
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.poses.knots import Knots, on_spline, spline_weights

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Look = Callable[[RayBundle, Float[Tensor, "b C"]], Float[Tensor, "R D"]]
"""What a scene shows along rays: the camera's channels times a matrix, then the opacity where it is known."""

_MOST_PIXELS, _FEWEST_COLUMNS = 20_000, 16
_CHANNELS = 3
"""In which spectra vary most, that are compared."""
_ROUNDS = ((17, 6, 30.0), (9, 6, 30.0), (5, 6, 30.0), (3, 6, 30.0), (1, 2, 3.0))
"""Edge of the squares of pixels over which pictures are averaged, pixels: rows that are off by ten pixels look alike on
averages; iterations; and the error from which a pixel pulls no more strongly, in standard deviations."""
_DIFFERENCE_PX = 0.5
_DAMPING, _TRIES = 1e-4, 5
"""The first damping, and how many are tried for a step, each ten times the one before."""
_NOTHING = 1e-4
"""Error and slope of a pixel below which it tells nothing."""
_MEDIAN_TO_DEVIATION = 1.48
_BEND_PX, _DRIFT_PX, _SIZE_PX = 1.0, 2.0, 100.0
"""Standard deviations in pixels: of the bend at a knot, of the drift from a knot to the next, and of a step."""
_NUMBERS = 6


def fit_rows(
    camera: Cameras,
    spectra: Float[Tensor, "rows columns b"],
    valid: Bool[Tensor, "rows columns"],
    alpha: Float[Tensor, "rows columns"] | None,
    box: SceneBox,
    look: Look,
) -> Cameras:
    """A line camera with a key pose a row, after which the scene looks more like what was measured.

    Args:
        camera: One line camera on the scene's device, from whose poses steps start.
        spectra, valid, alpha: What it measured, which pixels count, and their opacity where it is known.
        box: Of the scene.
        look: See `Look`; it gives the opacity exactly where `alpha` is given.
    """
    width, num_rows = camera.size(0)
    count = min(width, max(_FEWEST_COLUMNS, _MOST_PIXELS // num_rows))
    columns = ((torch.arange(count) + 0.5) * width / count).long()
    spectra, valid = spectra[:, columns].float(), valid[:, columns]
    axes = main_axes(spectra[valid])
    measured = [spectra @ axes] + ([] if alpha is None else [alpha[:, columns].float()[..., None]])
    counts = valid.float()[..., None]
    y, x = torch.meshgrid(torch.arange(num_rows) + 0.5, columns + 0.5, indexing="ij")
    coords = torch.stack([x, y], dim=-1).view(-1, 2).to(camera.camera_to_world)
    rays = camera.generate_rays(torch.zeros_like(coords[:, 0], dtype=torch.int64), coords)
    distances = (rays.origins - box.aabb.mean(dim=0).to(rays.origins)).norm(dim=1)
    view = _SweptView(
        rays,
        (torch.cat(measured, dim=-1) * counts).cpu(),
        counts.cpu(),
        max(float(distances.mean()), 1e-6),
        1 / float(camera.focal_px[0, 0]),
        lambda some: look(some, axes.to(some.origins)).cpu(),
    )
    steps = torch.zeros(view.num_knots, _NUMBERS, dtype=torch.float64)
    for blur, iterations, reach in _ROUNDS:
        steps = _fitted(view, steps, blur, iterations, reach)
    return view.moved(camera, steps)


def main_axes(spectra: Float[Tensor, "P b"]) -> Float[Tensor, "b C"]:
    """The few directions in which spectra vary most; without spectra, some bands."""
    if len(spectra) == 0:
        return torch.eye(spectra.shape[1], min(_CHANNELS, spectra.shape[1]), device=spectra.device)
    some = spectra[:: max(1, len(spectra) // 20_000)]
    return torch.linalg.svd(some, full_matrices=False).Vh[:_CHANNELS].T


@dataclass(frozen=True)
class _SweptView:
    """What one line camera measured, and the scene that should look like it."""

    rays: RayBundle
    """H * W of them, row after row, as the poses send them that steps start from."""
    measured: Float[Tensor, "H W D"]
    counts: Float[Tensor, "H W 1"]
    """Share of each pixel that counts, [0, 1]."""
    distance: float
    """From the camera to the scene's middle, model space."""
    pixel: float
    """Angle of a pixel, radians."""
    show: Callable[[RayBundle], Float[Tensor, "R D"]]

    @property
    def num_knots(self) -> int:
        return Knots((len(self.measured),)).counts[0]

    def places(self) -> tuple[Int[Tensor, " H"], Float64[Tensor, "H 4"]]:
        """Of each row the first of the four knots that tell of it, and their weights."""
        rows = len(self.measured)
        place = (torch.arange(rows) + 0.5).double() / rows * (self.num_knots - 1)
        return spline_weights(place, torch.full((rows,), self.num_knots))

    def at_rows(self, steps: Float64[Tensor, "n 6"]) -> Float64[Tensor, "H 6"]:
        return on_spline(steps, *self.places())

    def shown(self, steps: Float64[Tensor, "m H 6"]) -> Float[Tensor, "m H W D"]:
        """What the scene shows after each of some ways to move all rows."""
        rays = RayBundle.join([self._moved_rays(step.float()) for step in steps])
        return self.show(rays).view(len(steps), *self.measured.shape)

    def residuals(self, steps: Float64[Tensor, "n 6"], blur: int) -> Float64[Tensor, "H W D"]:
        shown = self.shown(self.at_rows(steps)[None])
        return _blurred((shown - self.measured) * self.counts, blur)[0].double()

    def slopes(self, steps: Float64[Tensor, "n 6"], blur: int) -> Float64[Tensor, "H W D 6"]:
        """How each pixel changes with the pose of its row, by central differences; where pictures are blurred, with
        the poses of the rows around it, since these move alike."""
        difference = _DIFFERENCE_PX * self.pixel
        moves = difference * torch.eye(_NUMBERS, dtype=torch.float64)
        ahead, behind = self.shown(self.at_rows(steps) + torch.cat([moves, -moves])[:, None]).chunk(2)
        slopes = _blurred((ahead - behind) / (2 * difference) * self.counts, blur)
        return slopes.double().permute(1, 2, 3, 0)

    def moved(self, camera: Cameras, steps: Float64[Tensor, "n 6"]) -> Cameras:
        """The camera whose view this is, after steps."""
        rows = self.at_rows(steps).float().to(camera.camera_to_world)
        heights = (torch.arange(len(rows)) + 0.5).to(rows)
        poses = camera.poses_at(torch.zeros_like(heights, dtype=torch.int64), heights)
        turned = rotation_matrix(rows[:, :3]) @ poses[:, :, :3]
        places = poses[:, :, 3] + self.distance * rows[:, 3:]
        keys = KeyPoses(torch.cat([turned, places[:, :, None]], dim=-1), heights, (len(rows),))
        return replace(camera, key_poses=keys)

    def _moved_rays(self, steps: Float[Tensor, "H 6"]) -> RayBundle:
        each = steps.repeat_interleave(self.measured.shape[1], dim=0).to(self.rays.origins)
        directions = (rotation_matrix(each[:, :3]) @ self.rays.directions[:, :, None])[:, :, 0]
        origins = self.rays.origins + self.distance * each[:, 3:]
        return replace(self.rays, origins=origins, directions=directions, axes=None)


def _fitted(
    view: _SweptView, steps: Float64[Tensor, "n 6"], blur: int, iterations: int, reach: float
) -> Float64[Tensor, "n 6"]:
    """Steps after which rows look more like what was measured; as they were where none does."""
    prior, damping = _smooth_prior(view.num_knots, view.pixel), _DAMPING

    def large(steps: Float64[Tensor, "n 6"]) -> float:
        return float((steps.numpy() * (prior @ steps.numpy())).sum())

    found = view.residuals(steps, blur)
    for _ in range(iterations):
        slopes = view.slopes(steps, blur)
        tells = (found.abs().amax(dim=-1) > _NOTHING) | (slopes.abs().amax(dim=(-2, -1)) > _NOTHING)
        if not bool(tells.any()):
            return steps
        errors = found.square().mean(dim=-1).sqrt()
        deviation = _MEDIAN_TO_DEVIATION * float(errors[tells].median()) + _NOTHING
        limit = reach * deviation

        weights = (limit / errors.clamp(min=limit)) / deviation**2
        blocks, pull = _equations(view, slopes, found, weights)
        for apart in range(min(3, view.num_knots)):
            diagonal = prior.diagonal(apart)
            blocks[apart, : len(diagonal)] += diagonal[:, None, None] * np.eye(_NUMBERS)
        pull, before = pull + prior @ steps.numpy(), _cost(found, limit, deviation) + large(steps)
        for _ in range(_TRIES):
            tried = steps - torch.from_numpy(_solve_banded(blocks, pull, damping))
            seen = view.residuals(tried, blur)
            if _cost(seen, limit, deviation) + large(tried) < before:
                steps, found, damping = tried, seen, max(damping / 3, 1e-6)
                break
            damping *= 10
        else:
            return steps
    return steps


def _cost(found: Float64[Tensor, "H W D"], limit: float, deviation: float) -> float:
    """Huber's sum over pixels, in variances."""
    errors = found.square().mean(dim=-1).sqrt()
    costs = torch.where(errors < limit, errors.square(), 2 * limit * errors - limit**2)
    return float(costs.sum()) / deviation**2


def _blurred(pictures: Float[Tensor, "m H W D"], edge: int) -> Float[Tensor, "m H W D"]:
    """Pictures averaged over squares of pixels of an odd edge."""
    if edge == 1:
        return pictures
    flat = pictures.permute(0, 3, 1, 2)
    means = torch.nn.functional.avg_pool2d(flat, edge, 1, edge // 2, count_include_pad=False)
    return means.permute(0, 2, 3, 1)


def _equations(
    view: _SweptView,
    slopes: Float64[Tensor, "H W D 6"],
    found: Float64[Tensor, "H W D"],
    weights: Float64[Tensor, "H W"],
) -> tuple[Float64[np.ndarray, "4 n 6 6"], Float64[np.ndarray, "n 6"]]:
    """Normal equations of the knots: each row adds to the four that tell of it. Block (d, a) couples knot a with knot
    a + d."""
    channels, count = found.shape[-1], view.num_knots
    weighed = slopes * (weights / channels)[..., None, None]
    normal = torch.einsum("hwdi,hwdj->hij", weighed, slopes)
    pull = torch.einsum("hwdi,hwd->hi", weighed, found)
    first, shares = view.places()
    blocks, pulls = torch.zeros(4, count, 6, 6).double(), torch.zeros(count, 6).double()
    for low in range(4):
        pulls.index_add_(0, first + low, pull * shares[:, low, None])
        for high in range(low, 4):
            both = (shares[:, low] * shares[:, high])[:, None, None]
            blocks[high - low].index_add_(0, first + low, normal * both)
    return blocks.numpy(), pulls.numpy()


def _smooth_prior(num_knots: int, pixel: float) -> csr_matrix:
    """The matrix P of what rough or large steps s cost, s^T P s; `pixel` is its angle in radians."""
    from scipy.sparse import csr_matrix, identity

    first, total = csr_matrix(identity(num_knots)), identity(num_knots) / _SIZE_PX**2
    for deviation in (_DRIFT_PX, _BEND_PX):
        first = first[1:] - first[:-1]
        total = total + (first.T @ first) / deviation**2
    return (total / pixel**2).tocsr()


def _solve_banded(
    blocks: Float64[np.ndarray, "4 n 6 6"], pull: Float64[np.ndarray, "n 6"], damping: float
) -> Float64[np.ndarray, "n 6"]:
    """Solution of normal equations whose diagonal is larger by the share `damping` (Levenberg-Marquardt). `blocks` are
    the lower half: rows of block (d, a) are numbers of knot a + d, columns those of knot a."""
    from scipy.linalg import solveh_banded

    num_knots, bandwidth = blocks.shape[1], 4 * _NUMBERS - 1
    band = np.zeros((bandwidth + 1, _NUMBERS * num_knots))
    for apart in range(min(4, num_knots)):
        for row in range(_NUMBERS):
            for column in range(_NUMBERS):
                below = _NUMBERS * apart + row - column
                if 0 <= below <= bandwidth:
                    own = blocks[apart, : num_knots - apart, row, column]
                    band[below, column::_NUMBERS][: num_knots - apart] = own
    band[0] *= 1 + damping
    return solveh_banded(band, pull.ravel(), lower=True).reshape(pull.shape)
