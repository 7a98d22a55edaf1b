"""Poses and lens corrected while training: small tangent steps of rotation and position.

A correction is a function of the view and of the row: one step for a frame camera, and for a line camera a sum of
waves, computed at the knots of a cubic spline a few rows apart. Given cameras stay what they are: their rays are moved,
and where the lens is corrected too, made anew from pixel coordinates by the camera with the corrected lens.

What moves all views alike (a similarity of the world about the scene's middle) can't be seen in pictures, so it is
taken out of the corrections. A view that goes farther than `LARGEST_STEP` has lost its way: it gets its given pose
back, and keeps it unless the grid is still coarse.

A pose that is wrong by many pixels asks for density where nothing is, and gets haze. So the errors of pixels that
show the foreground are kept in mind for each knot. Where they are more than `LARGEST_RATIO` times the median, the
pixels are outliers: they shape the scene less, by the square of what is too much, but pull at their pose with full
weight.

Notation: `V` training views, `M` knots of all views, `R` rays. A step is (w, m): the camera turns by the rotation
vector w in world axes about itself, and moves by m times its reach, both times its scale.

Source: Lin et al. 2021, BARF (joint refinement, coarse to fine); Wang et al. 2021, NeRF-- (focal length).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses, rotation_matrix
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.processes import Processes
from unmix_plugin.operators.compositing import scale_gradient
from unmix_plugin.poses.knots import Knots, on_spline, row_waves, similarities, spline_weights


class _LensRefinement(nn.Module):
    """A correction of the lens that all views share, 0 at first."""

    def __init__(self, refined: Literal["fixed", "focal", "radial"] = "fixed") -> None:
        """What is corrected: nothing, the focal length, or also k1 and k2."""
        super().__init__()
        self.is_refined, self.is_bent = refined != "fixed", refined == "radial"
        self.steps = nn.Parameter(torch.zeros(3), requires_grad=self.is_refined)
        """Logarithm of the factor of the focal length, then what is added to k1 and k2."""

    def of(self, cameras: Cameras) -> Cameras:
        """Cameras with the corrected lens."""
        steps = self.steps.to(cameras.focal_px)
        found = replace(cameras, focal_px=cameras.focal_px * steps[0].exp())
        if not self.is_bent:
            return found
        change = torch.cat([steps[1:], steps.new_zeros(cameras.distortion.shape[1] - 2)])
        return replace(found, distortion=cameras.distortion + change)


LARGEST_RATIO = 4.0
"""Mean squared error of a knot's pixels over the median, up to which they are inliers: it varies as much with what
pixels show."""
_MEMORY = 0.98
"""Part of what is kept in mind that is left after a step."""
_FEWEST_PIXELS = 3.0
"""Kept in mind, from which on a knot's error is known."""
_LEAST_WEIGHT = 1e-4


class RobustWeights(nn.Module):
    """Errors of the pixels around each knot, and what these pixels weigh; all 1 at first."""

    squares: Tensor
    counts: Tensor
    weights: Tensor

    def __init__(self, num_knots: int) -> None:
        """`num_knots` is M."""
        super().__init__()
        self.register_buffer("squares", torch.zeros(num_knots))
        self.register_buffer("counts", torch.zeros(num_knots))
        self.register_buffer("weights", torch.ones(num_knots))

    @torch.no_grad()
    def update(
        self, knots: Int[Tensor, " R"], squares: Float[Tensor, " R"], shows_foreground: Bool[Tensor, " R"]
    ) -> None:
        """Note the mean squared errors of pixels, each near one of the knots; infinite ones and NaN are left out."""
        is_known = shows_foreground & squares.isfinite()
        shown, squares = is_known.to(squares), squares.where(is_known, 0.0)
        self.squares.mul_(_MEMORY).index_add_(0, knots, squares)
        self.counts.mul_(_MEMORY).index_add_(0, knots, shown)

    @torch.no_grad()
    def judge(self, processes: Processes) -> None:
        """Decide what pixels weigh, alike in all processes."""
        processes.reduce(self.squares, "mean")
        processes.reduce(self.counts, "mean")
        is_known = self.counts > _FEWEST_PIXELS
        errors = self.squares / self.counts.clamp(min=_FEWEST_PIXELS)
        usual = errors[is_known].median() if bool(is_known.any()) else errors.new_ones(())
        inlying = (LARGEST_RATIO * usual / errors.clamp(min=1e-12)).clamp(max=1.0)
        self.weights.copy_(torch.where(is_known, inlying.square().clamp(min=_LEAST_WEIGHT), 1.0))


LARGEST_STEP = 0.25
"""Radians, or share of the distance to the scene's middle, beyond which a correction is undone; of a line camera in the
mean over its knots."""
_SMALLEST_SIGHT = 0.25
"""Half of the scene's longest edge over its distance, below which `LARGEST_STEP` is smaller in proportion: through a
long lens, the same turn moves the picture by more of its width."""
_COARSEST_PIXEL = 6.8e-3
"""Angle of a pixel, radians, below which steps are smaller in proportion: they are a share of a pixel, however fine."""
_LINE_REACH = 0.25
"""Reach of a line camera as a share of its distance to the scene's middle, which is the reach of a frame camera. A row
can hardly tell a shift from a turn: steps of equal effect would split between both what is mostly a turn, and parallax
sorts it out slowly."""
_SIZE_PENALTY = 1e-3
"""Weight of the mean squared correction."""
_BEND_PENALTY = 1.5
"""Weight of the mean squared bend (second difference between knots) of a line camera's corrections: what carries a
camera moves smoothly, and rows that see little follow their neighbours."""
_MOST_UNDONE = 0.5
"""Share of the views that may be undone before all are."""


class PoseRefinement(nn.Module):
    """Corrections of the training views' poses, all 0 at first."""

    reach: Tensor
    scale: Tensor
    """Radians, or reaches, that a step of 1 stands for at each knot, in (0, 1]."""
    bound: Tensor
    """Largest correction at each knot, radians or share of the distance to the scene's middle."""
    fractions: Tensor
    """Of the distance to the scene's middle, that are the reach at each knot."""
    gauge: Tensor
    """Directions of steps that pictures can't tell: all cameras turned, moved or scaled alike (the ambiguity of
    scale)."""
    is_free: Tensor
    carved: Tensor
    """Whether space was carved by the corrected cameras."""
    counts: Tensor
    first: Tensor
    rows: Tensor

    def __init__(self, rows: Sequence[int], lens: Literal["fixed", "focal", "radial"] = "fixed") -> None:
        """`rows` as `Knots` has them."""
        super().__init__()
        self.knots = Knots(tuple(rows))
        counts = torch.tensor(self.knots.counts)
        total = int(counts.sum())
        self.steps = nn.Parameter(torch.zeros(total, 6))
        self.lens = _LensRefinement(lens)
        self.robust = RobustWeights(total)
        self.register_buffer("reach", torch.ones(total))
        self.register_buffer("scale", torch.ones(total))
        self.register_buffer("bound", torch.full((total,), LARGEST_STEP))
        fractions = torch.where(counts > 1, _LINE_REACH, 1.0).repeat_interleave(counts)
        self.register_buffer("fractions", fractions, persistent=False)
        self.register_buffer("gauge", torch.zeros(6 * total, 7))
        self.register_buffer("is_free", torch.ones(len(rows), dtype=torch.bool))
        self.register_buffer("carved", torch.zeros((), dtype=torch.bool))
        self.register_buffer("counts", counts, persistent=False)
        self.register_buffer("first", counts.cumsum(0) - counts, persistent=False)
        self.register_buffer("rows", torch.tensor(rows), persistent=False)
        # Steps of a line camera are amounts of waves over its rows. Views of as many knots are computed together.
        self.lines = sorted({count for count in self.knots.counts if count > 1})
        for count in self.lines:
            own = (counts == count).nonzero()[:, 0]
            places = self.first[own, None] + torch.arange(count)
            self.register_buffer(f"places_{count}", places, persistent=False)
            self.register_buffer(f"waves_{count}", row_waves(count), persistent=False)

    @torch.no_grad()
    def begin(self, positions: Float[Tensor, "M 3"], box: SceneBox, pixel_size: float) -> None:
        """Take in where the cameras stand at the knots, the scene, and how large a pixel is at its middle."""
        offsets = (positions - box.aabb.mean(dim=0)).to(self.fractions)
        distances = offsets.norm(dim=1).clamp(min=1e-6)
        self.reach.copy_(self.fractions * distances)
        self.scale.copy_((pixel_size / distances / _COARSEST_PIXEL).clamp(max=1.0))
        sight = 0.5 * box.size.max() / distances
        self.bound.copy_(LARGEST_STEP * (sight / _SMALLEST_SIGHT).clamp(max=1.0))
        self.gauge.copy_(similarities(offsets, self.reach, self.scale))

    def free_steps(self) -> Float[Tensor, "M 6"]:
        """Steps without what moves all views alike; 0 for views that were undone."""
        free = self.is_free.repeat_interleave(self.counts)[:, None]
        steps = (self._at_knots() * free).flatten()
        return (steps - self.gauge @ (self.gauge.T @ steps)).view(-1, 6) * free

    @torch.no_grad()
    def figures(self, steps: Float[Tensor, "M 6"]) -> dict[str, Tensor]:
        """`pose_turn_deg` and `pose_shift` (share of the distance to the scene's middle), means over knots,
        `poses_undone`, and the share of the knots that are outliers, `pose_outliers`; of `free_steps`."""
        turns, shifts = self._sizes(steps).mean(dim=0)
        return {
            "pose_turn_deg": turns.rad2deg(),
            "pose_shift": shifts,
            "poses_undone": (~self.is_free).sum().float(),
            "pose_outliers": (self.robust.weights < 0.5).float().mean(),
        }

    def penalty(self, steps: Float[Tensor, "M 6"]) -> Float[Tensor, ""]:
        """What large and rough corrections cost; of `free_steps`."""
        bends = [steps[self.get_buffer(f"places_{count}")].diff(n=2, dim=1).flatten() for count in self.lines]
        second = torch.cat([steps.new_zeros(0), *bends])
        large = steps.square().mean() + self.lens.steps.square().sum()
        return _SIZE_PENALTY * large + _BEND_PENALTY * second.square().sum() / max(1, len(second))

    def nearest_knots(self, rays: RayBundle) -> Int[Tensor, " R"]:
        """Of rays as `forward` takes them."""
        assert rays.pixel_coords is not None
        views = rays.camera_indices
        return self.first[views] + self._place(views, rays.pixel_coords[:, 1]).round().long()

    def forward(
        self,
        rays: RayBundle,
        cameras: Cameras | None = None,
        steps: Float[Tensor, "M 6"] | None = None,
        pull: Float[Tensor, " R"] | None = None,
    ) -> RayBundle:
        """Rays of training views as their corrected cameras send them.

        Args:
            rays: As `Cameras.generate_rays` makes them.
            cameras: The given ones, on the rays' device; needed where the lens is corrected.
            steps: `free_steps`, where they are known.
            pull: Factor on the gradients of the poses.
        """
        assert rays.axes is not None
        assert rays.pixel_coords is not None
        steps = self.free_steps() if steps is None else steps
        turns, moves = self._at(steps, rays.camera_indices, rays.pixel_coords[:, 1])
        if pull is not None:
            turns, moves = scale_gradient(turns, pull[:, None, None]), scale_gradient(moves, pull[:, None])
        if self.lens.is_refined:
            assert cameras is not None, "the lens is corrected: rays are made anew by the given cameras"
            rays = self.lens.of(cameras).generate_rays(rays.camera_indices, rays.pixel_coords)
            assert rays.axes is not None
        directions, axes = ((turns @ x[:, :, None])[:, :, 0] for x in (rays.directions, rays.axes))
        return replace(rays, origins=rays.origins + moves, directions=directions, axes=axes)

    @torch.no_grad()
    def corrected_lens(self, cameras: Cameras) -> Cameras:
        """Any cameras of the scene with the corrected lens; their poses stay."""
        return self.lens.of(cameras)

    @torch.no_grad()
    def refined(self, cameras: Cameras) -> Cameras:
        """The training cameras, corrected: key poses of line cameras stand at the given heights, in the middle of each
        row and at the ends."""
        own, steps = self.lens.of(cameras.to(self.steps.device)), self.free_steps()
        middles = 0.5 * self.steps.new_tensor([own.size(index)[1] for index in range(len(own))])
        views = torch.arange(len(own), device=middles.device)
        moved = replace(own, camera_to_world=self._moved(own, steps, views, middles))
        if own.key_poses is not None:
            keys = [self._keys(own, steps, view) for view in range(len(own))]
            moved = replace(moved, key_poses=KeyPoses.join(keys))
        return moved.to(cameras.camera_to_world.device)

    @torch.no_grad()
    def restore_best(self, is_final: bool = True) -> None:
        """Give views that went too far their poses back, where most did, all; they keep them if it is final."""
        sizes = self._sizes(self.free_steps()).amax(dim=1) / self.bound
        views = torch.arange(len(self.is_free), device=sizes.device).repeat_interleave(self.counts)
        # In the mean over its knots: a line camera may wobble farther in a few rows and still be on its way.
        size = torch.zeros(len(self.is_free), device=sizes.device).index_add_(0, views, sizes) / self.counts
        is_held = self.is_free & (size <= 1)
        is_held &= is_held.float().mean() >= 1 - _MOST_UNDONE
        self.steps.masked_fill_(~is_held[views][:, None], 0.0)
        if is_final:
            self.is_free.copy_(is_held)

    def _sizes(self, steps: Float[Tensor, "M 6"]) -> Float[Tensor, "M 2"]:
        """Of turns, radians, and shifts, share of the distance to the scene's middle."""
        turns, shifts = (steps * self.scale[:, None]).view(-1, 2, 3).norm(dim=-1).unbind(dim=1)
        return torch.stack([turns, shifts * self.fractions], dim=1)

    def _at_knots(self) -> Float[Tensor, "M 6"]:
        """What the steps add up to at the knots."""
        found = self.steps
        for count in self.lines:
            places = self.get_buffer(f"places_{count}")
            found = found.index_put((places,), self.get_buffer(f"waves_{count}") @ self.steps[places])
        return found

    def _at(
        self, steps: Float[Tensor, "M 6"], views: Int[Tensor, " R"], y: Float[Tensor, " R"]
    ) -> tuple[Float[Tensor, "R 3 3"], Float[Tensor, "R 3"]]:
        """Rotation and shift of each ray's camera."""
        turns, moves = (steps * self.scale[:, None]).split(3, dim=1)
        scaled = torch.cat([turns, moves * self.reach[:, None]], dim=1)
        if self.lines:
            start, weights = spline_weights(self._place(views, y), self.counts[views])
            step = on_spline(scaled, self.first[views] + start, weights)
        else:
            step = scaled.index_select(0, self.first[views])
        return rotation_matrix(step[:, :3]), step[:, 3:]

    def _place(self, views: Int[Tensor, " R"], y: Float[Tensor, " R"]) -> Float[Tensor, " R"]:
        """Where rays start among the knots of their views, from 0."""
        return y / self.rows[views].clamp(min=1) * (self.counts[views] - 1)

    def _moved(
        self, cameras: Cameras, steps: Tensor, views: Int[Tensor, " n"], y: Float[Tensor, " n"]
    ) -> Float[Tensor, "n 3 4"]:
        poses, (turns, moves) = cameras.poses_at(views, y), self._at(steps, views, y)
        return torch.cat([turns @ poses[:, :, :3], (poses[:, :, 3] + moves)[:, :, None]], dim=-1)

    def _keys(self, cameras: Cameras, steps: Tensor, view: int) -> KeyPoses:
        assert cameras.key_poses is not None
        heights = cameras.key_poses.of(view).heights
        if rows := self.knots.rows[view]:
            middles = torch.arange(rows).to(heights) + 0.5
            heights = torch.cat([heights, middles, heights.new_tensor([0.0, rows])]).unique()
        views = torch.full((len(heights),), view, device=heights.device)
        poses = self._moved(cameras, steps, views, heights)
        return KeyPoses(poses, heights, (len(heights),))
