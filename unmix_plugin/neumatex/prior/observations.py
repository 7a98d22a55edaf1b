"""Numbers that a network can learn from: what views show of points, beside the light that was there.

Notation: leading axes are objects and `N` points; `V` views, `K` lobes of light, `F` features. Colours and light are
divided by the environment's mean radiance, so that exposure does not matter.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from unmix_plugin.neumatex.prior.light_lobes import NUM_LOBES
from unmix_plugin.neumatex.triplane import encode

NUM_VIEW_FEATURES = 3 + 3 * NUM_LOBES + 3 + 3 + 3
NUM_POINT_FEATURES = 3 + 3 + 1 + 3 + 18 + 7 * NUM_LOBES
_BRIGHTEST = 8.0
"""Light above this is cut: a sample of a path tracer or a clipped picture says no more."""
_RIDGE = 0.02
"""Variance that is added to that of the light in a fit, so that light that hardly varies explains little."""


def view_features(
    colours: Float[Tensor, "*n V 3"],
    cosines: Float[Tensor, "*n V"],
    mirrored: Float[Tensor, "*n V K 3"],
    mirror_open: Float[Tensor, "*n V"],
    reaching: Float[Tensor, "*n 3"],
) -> Float[Tensor, "*n V F"]:
    """What one view shows of a point and what light it could reflect to that view.

    Args:
        reaching: Irradiance over pi after shadows.
    """
    apparent = colours / (reaching[..., None, :] + 0.02)
    single = torch.stack([cosines, (1 - cosines) ** 5, mirror_open], dim=-1)
    light = compressed(reaching)[..., None, :].expand_as(colours)
    lobes = compressed(mirrored).flatten(-2)
    return torch.cat([compressed(colours), lobes, light, compressed(apparent), single], dim=-1)


def point_features(
    positions: Float[Tensor, "*n 3"],
    colours: Float[Tensor, "*n V 3"],
    visible: Bool[Tensor, "*n V"],
    mirrored: Float[Tensor, "*n V K 3"],
    mirror_open: Float[Tensor, "*n V"],
    irradiance: Float[Tensor, "*n 3"],
    unshadowed: Float[Tensor, "*n 3"],
) -> Float[Tensor, "*n F"]:
    """What all views together show of a point: fits of its colours by each lobe of light, and where it is."""
    weights = visible * (0.2 + 0.8 * mirror_open)
    fits = lobe_fits(colours, mirrored, weights, irradiance * unshadowed)
    seen = visible.sum(dim=-1, keepdim=True) / 8
    return torch.cat([compressed(irradiance), unshadowed, seen, positions, encode(positions), fits], dim=-1)


def lobe_fits(
    colours: Float[Tensor, "*n V 3"],
    mirrored: Float[Tensor, "*n V K 3"],
    weights: Float[Tensor, "*n V"],
    reaching: Float[Tensor, "*n 3"],
) -> Float[Tensor, "*n 7*K"]:
    """A constant plus a share of each lobe's light, fitted to a point's colours over the views.

    Returns:
        For each lobe: the shares of the three colours, the constants over the light that reaches the point (an albedo),
        and the part of the colours' variance that is left.
    """
    colours = colours.clamp(max=_BRIGHTEST)[..., None, :]
    light = mirrored.clamp(max=_BRIGHTEST)
    weights = weights[..., None, None]
    total = weights.sum(dim=-3).clamp(min=1e-6)

    def mean(values: Tensor) -> Tensor:
        return (values * weights).sum(dim=-3) / total

    mean_colour, mean_light = mean(colours), mean(light)
    spread = light - mean_light[..., None, :, :]
    difference = colours - mean_colour[..., None, :, :]
    share = mean(spread * difference) / (mean(spread.square()) + _RIDGE)
    constant = (mean_colour - share * mean_light) / (reaching[..., None, :] + 0.02)
    left = mean((difference - share[..., None, :, :] * spread).square()).sum(dim=-1, keepdim=True)
    left = left / (mean(difference.square()).sum(dim=-1, keepdim=True) + 1e-3)
    return torch.cat([share.clamp(-1, 2), constant.clamp(-1, 2), left.clamp(0, 2)], dim=-1).flatten(-2)


def compressed(light: Tensor) -> Tensor:
    """Light from 0 to `_BRIGHTEST` on a logarithmic scale from 0 to 1."""
    return torch.log1p(8 * light.clamp(0, _BRIGHTEST)) / torch.log1p(torch.tensor(8 * _BRIGHTEST))
