"""Poses corrected while training: small tangent steps of rotation and position.

A correction is a function of the view and of the row: one step for a frame camera, and for a line camera a sum of
waves, computed at the knots of a cubic spline a few rows apart. Given poses stay what they are; rays are moved.

What moves all views alike (a similarity of the world about the scene's middle) can't be seen in pictures, so it is
taken out of the corrections. A view that goes farther than `LARGEST_STEP` has lost its way: it gets its given pose
back, and keeps it unless the grid is still coarse.

Notation: `V` training views, `M` knots of all views, `R` rays. A step is (w, m): the camera turns by the rotation
vector w in world axes about itself, and moves by m times its reach, both times its scale.

Source: Lin et al. 2021, BARF (joint refinement, coarse to fine).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses, rotation_matrix
from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.operators.compositing import scale_gradient
from unmix_plugin.poses.knots import Knots, on_spline, row_waves, similarities, spline_weights
from unmix_plugin.poses.lens import LensRefinement
from unmix_plugin.poses.settings import PoseConfig
from unmix_plugin.poses.trust import PoseTrust

LARGEST_STEP = 0.25
"""Radians, or share of the distance to the scene's middle, beyond which a correction is undone; of a line camera in the
mean over its knots."""
SMALLEST_SIGHT = 0.25
"""Half of the scene's longest edge over its distance, below which `LARGEST_STEP` is smaller in proportion: through a
long lens, the same turn moves the picture by more of its width."""
COARSEST_PIXEL = 6.8e-3
"""Angle of a pixel, radians, below which steps are smaller in proportion: they are a share of a pixel, however fine."""
LINE_REACH = 0.25
"""Reach of a line camera as a share of its distance to the scene's middle, which is the reach of a frame camera. A row
can hardly tell a shift from a turn: steps of equal effect would split between both what is mostly a turn, and parallax
sorts it out slowly."""
_COMPARED = ("spectral", "coefficients", "accumulation", "abundances")
"""Outputs of rays that losses compare with pixels."""
MOST_UNDONE = 0.5
"""Share of the views that may be undone before all are."""


class PoseRefinement(nn.Module):
    """Corrections of the training views' poses, all 0 at first."""

    reach: Tensor
    scale: Tensor
    """Radians, or reaches, that a step of 1 stands for at each knot, in (0, 1]."""
    bound: Tensor
    """Largest correction at each knot, radians or share of the distance to the scene's middle."""
    shares: Tensor
    """Of the distance to the scene's middle, that are the reach at each knot."""
    gauge: Tensor
    is_free: Tensor
    settled: Tensor
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
        self.lens = LensRefinement(lens)
        self.trust = PoseTrust(total)
        self.register_buffer("reach", torch.ones(total))
        self.register_buffer("scale", torch.ones(total))
        self.register_buffer("bound", torch.full((total,), LARGEST_STEP))
        shares = torch.where(counts > 1, LINE_REACH, 1.0).repeat_interleave(counts)
        self.register_buffer("shares", shares, persistent=False)
        self.register_buffer("gauge", torch.zeros(6 * total, 7))
        self.register_buffer("is_free", torch.ones(len(rows), dtype=torch.bool))
        self.register_buffer("settled", torch.zeros((), dtype=torch.bool))
        self.is_settled = False
        """Whether the scene was judged by the corrected cameras; the buffer keeps it, but reading that from a GPU in
        each step would take time."""
        self.register_load_state_dict_post_hook(_after_loading)
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
        offsets = positions - box.aabb.mean(dim=0)
        distances = offsets.norm(dim=1).clamp(min=1e-6)
        self.reach.copy_(self.shares * distances)
        self.scale.copy_((pixel_size / distances / COARSEST_PIXEL).clamp(max=1.0))
        sight = 0.5 * box.size.max() / distances
        self.bound.copy_(LARGEST_STEP * (sight / SMALLEST_SIGHT).clamp(max=1.0))
        self.gauge.copy_(similarities(offsets, self.reach, self.scale))

    def settle(self) -> None:
        """Note that the scene was judged by the corrected cameras."""
        self.settled.fill_(True)
        self.is_settled = True

    @property
    def corrections(self) -> Float[Tensor, "M 6"]:
        """By how much the cameras are turned and moved at the knots."""
        return self._free_steps() * self.scale[:, None]

    def _free_steps(self) -> Float[Tensor, "M 6"]:
        """Steps without what moves all views alike; 0 for views that were undone."""
        free = self.is_free.repeat_interleave(self.counts)[:, None]
        steps = (self._at_knots() * free).flatten()
        return (steps - self.gauge @ (self.gauge.T @ steps)).view(-1, 6) * free

    @property
    def num_undone(self) -> int:
        """Views that were given their poses back."""
        return int((~self.is_free).sum())

    @torch.no_grad()
    def figures(self) -> dict[str, Tensor]:
        """`pose_turn_deg` and `pose_shift` (share of the distance to the scene's middle), means over knots,
        `poses_undone`, and the share of the knots that is hardly believed, `poses_doubted`."""
        turns, shifts = self._sizes().mean(dim=0)
        return {
            "pose_turn_deg": turns.rad2deg(),
            "pose_shift": shifts,
            "poses_undone": (~self.is_free).sum().float(),
            "poses_doubted": (self.trust.weights < 0.5).float().mean(),
        }

    def penalty(self, config: PoseConfig) -> Float[Tensor, ""]:
        """What large and rough corrections cost."""
        steps = self._free_steps()
        bends = [steps[self.get_buffer(f"places_{count}")].diff(n=2, dim=1).flatten() for count in self.lines]
        bent = torch.cat([steps.new_zeros(0), *bends])
        large = steps.square().mean() + self.lens.penalty()
        return config.penalty * large + config.roughness * bent.square().sum() / max(1, len(bent))

    def nearest_knots(self, rays: RayBundle) -> Int[Tensor, " R"]:
        """Of rays as `forward` takes them."""
        assert rays.image_y is not None
        views = rays.camera_indices
        return self.first[views] + self._place(views, rays.image_y).round().long()

    def believed(self, outputs: dict[str, Tensor], rays: RayBundle) -> dict[str, Tensor]:
        """Outputs of training rays through which these shape the scene as far as their poses are believed, and the
        `knots` (R) that are nearest to them."""
        knots = self.nearest_knots(rays)
        weights = self.trust.weights[knots]
        compared = {
            name: scale_gradient(value, weights.view(-1, *[1] * (value.dim() - 1)))
            for name, value in outputs.items()
            if name in _COMPARED
        }
        return {**outputs, **compared, "knots": knots}

    def forward(self, rays: RayBundle) -> RayBundle:
        """Rays of training views as their corrected cameras send them.

        Args:
            rays: As `Cameras.generate_rays` makes them.
        """
        assert rays.axes is not None
        assert rays.image_y is not None
        turns, moves = self._at(rays.camera_indices, rays.image_y)
        # What is not believed is to be mended: `believed` takes the weight off the scene, not off the pose.
        pull = 1 / self.trust.weights[self.nearest_knots(rays)][:, None]
        turns, moves = scale_gradient(turns, pull[:, :, None]), scale_gradient(moves, pull)
        directions, axes = ((turns @ x[:, :, None])[:, :, 0] for x in (rays.directions, rays.axes))
        return replace(rays, origins=rays.origins + moves, directions=self.lens(directions, axes), axes=axes)

    @torch.no_grad()
    def refined(self, cameras: Cameras) -> Cameras:
        """The training cameras, corrected: key poses of line cameras stand at the given heights, in the middle of each
        row and at the ends."""
        own = self.lens.of(cameras.to(self.steps.device))
        moved = replace(own, camera_to_world=self._moved(own, torch.arange(len(own)), self._middles(own)))
        if own.key_poses is not None:
            moved = replace(
                moved, key_poses=KeyPoses.join([self._keys(own, view) for view in range(len(own))])
            )
        return moved.to(cameras.camera_to_world.device)

    @torch.no_grad()
    def undo_runaways(self, is_final: bool = True) -> None:
        """Give views that went too far their poses back; where most did, all.

        Args:
            is_final: Whether they keep them; else they may try again.
        """
        sizes = self._sizes().amax(dim=1) / self.bound
        views = torch.arange(len(self.is_free), device=sizes.device).repeat_interleave(self.counts)
        # In the mean over its knots: a line camera may wobble farther in a few rows and still be on its way.
        size = torch.zeros(len(self.is_free), device=sizes.device).index_add_(0, views, sizes) / self.counts
        is_held = self.is_free & (size <= 1)
        is_held &= is_held.float().mean() >= 1 - MOST_UNDONE
        self.steps.masked_fill_(~is_held[views][:, None], 0.0)
        if is_final:
            self.is_free.copy_(is_held)

    def _sizes(self) -> Float[Tensor, "M 2"]:
        """Of turns, radians, and shifts, share of the distance to the scene's middle."""
        turns, shifts = self.corrections.view(-1, 2, 3).norm(dim=-1).unbind(dim=1)
        return torch.stack([turns, shifts * self.shares], dim=1)

    def _at_knots(self) -> Float[Tensor, "M 6"]:
        """What the steps add up to at the knots."""
        found = self.steps
        for count in self.lines:
            places = self.get_buffer(f"places_{count}")
            found = found.index_put((places,), self.get_buffer(f"waves_{count}") @ self.steps[places])
        return found

    def _at(
        self, views: Int[Tensor, " R"], y: Float[Tensor, " R"]
    ) -> tuple[Float[Tensor, "R 3 3"], Float[Tensor, "R 3"]]:
        """Rotation and shift of each ray's camera."""
        turns, moves = self.corrections.split(3, dim=1)
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

    def _middles(self, cameras: Cameras) -> Float[Tensor, " V"]:
        sizes = [cameras.size(index)[1] for index in range(len(cameras))]
        return 0.5 * self.steps.new_tensor(sizes)

    def _moved(
        self, cameras: Cameras, views: Int[Tensor, " n"], y: Float[Tensor, " n"]
    ) -> Float[Tensor, "n 3 4"]:
        poses, (turns, moves) = cameras.poses_at(views, y), self._at(views, y)
        return torch.cat([turns @ poses[:, :, :3], (poses[:, :, 3] + moves)[:, :, None]], dim=-1)

    def _keys(self, cameras: Cameras, view: int) -> KeyPoses:
        assert cameras.key_poses is not None
        heights = cameras.key_poses.of(view).heights
        if rows := self.knots.rows[view]:
            middles = torch.arange(rows).to(heights) + 0.5
            heights = torch.cat([heights, middles, heights.new_tensor([0.0, rows])]).unique()
        poses = self._moved(cameras, torch.full((len(heights),), view, device=heights.device), heights)
        return KeyPoses(poses, heights, (len(heights),))


def _after_loading(poses: PoseRefinement, _: object) -> None:
    poses.is_settled = bool(poses.settled)
