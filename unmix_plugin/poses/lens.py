"""The lens that all views share, corrected while training: its focal length and its radial distortion.

Notation: `R` rays.

Source: Wang et al. 2021, NeRF-- (focal length).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.engine.geometry.cameras import Cameras, undistort


class LensRefinement(nn.Module):
    """A correction of the lens, 0 at first."""

    def __init__(self, refined: Literal["fixed", "focal", "radial"] = "fixed") -> None:
        """What is corrected: nothing, the focal length, or also k1 and k2."""
        super().__init__()
        self.is_refined, self.is_bent = refined != "fixed", refined == "radial"
        self.steps = nn.Parameter(torch.zeros(3), requires_grad=self.is_refined)
        """Logarithm of the factor of the focal length, then what is added to k1 and k2."""

    def penalty(self) -> Float[Tensor, ""]:
        """Sum of the squared corrections."""
        return self.steps.square().sum()

    @torch.no_grad()
    def of(self, cameras: Cameras) -> Cameras:
        """Cameras with the corrected lens."""
        steps = self.steps.to(cameras.focal_px)
        change = cameras.distortion.new_zeros(cameras.distortion.shape[1])
        change[:2] = steps[1:]
        return replace(
            cameras, focal_px=cameras.focal_px * steps[0].exp(), distortion=cameras.distortion + change
        )

    def forward(self, directions: Float[Tensor, "R 3"], axes: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        """Directions of rays as the corrected lens sends them.

        Args:
            directions: As the given lens sends them, unit vectors.
            axes: Of the cameras, unit vectors.
        """
        if not self.is_refined:
            return directions
        along = (directions * axes).sum(dim=1, keepdim=True)
        across = directions / along - axes
        scale = (-self.steps[0]).exp()
        if self.is_bent:
            radius = across.norm(dim=1).clamp(min=1e-9) * scale
            bent = torch.stack([radius, torch.zeros_like(radius)], dim=1)
            bending = torch.cat([self.steps[1:], self.steps.new_zeros(2)])[None]
            scale = scale * (undistort(bent, bending)[:, :1] / bent[:, :1])
        return nn.functional.normalize(axes + across * scale, dim=1)
