"""The metallic-roughness material that reflects most like another one, for every texel.

A small network from the parameters of a material to the five of glTF is trained on the materials of this surface, by
comparing reflected light in drawn pairs of directions; applied to all texels it is smooth where the materials are.

Notation: `T` materials, `P` their parameters, `D` pairs of directions for each.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.neumatex.tracing.families import MaterialFamily, PbrFamily
from unmix_plugin.neumatex.tracing.microfacet import cosine_directions

_STEPS, _DIRECTIONS, _WIDTH = 300, 16, 48
_CHUNK = 1 << 16
_JUDGED = 512
"""Materials whose error is measured."""


def fit_pbr(
    family: MaterialFamily,
    parameters: Float[Tensor, "T P"],
    generator: torch.Generator,
    steps: int | None = None,
    num_materials: int = 256,
) -> tuple[Float[Tensor, "T 5"], float]:
    """Base colour, roughness and metallicity of materials; those of `PbrFamily` stay as they are.

    Args:
        family: Of the materials, in three colours.
        parameters: [0, 1].
        generator: For the drawn materials and directions, on the CPU.
        steps: Of the network's training; None for as many as it takes.
        num_materials: Drawn in each step.
    Returns:
        Parameters of `PbrFamily`, and the mean absolute difference of reflected light x, cosine included, between all
        directions, as a part of its mean; light is compressed to x / (1 + x), as by an eye.
    """
    if isinstance(family, PbrFamily):
        return parameters.clone(), 0.0
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(torch.randint(1 << 31, (1,), generator=generator)))
        network = _Regression(family).to(parameters.device)
    optimiser, steps, pbr = torch.optim.Adam(network.parameters(), lr=1e-2), steps or _STEPS, PbrFamily()
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    with torch.enable_grad():
        for _ in range(steps):
            chosen = torch.randint(len(parameters), (num_materials,), generator=generator)
            materials = parameters[chosen.to(parameters.device)]
            repeated = materials.repeat_interleave(_DIRECTIONS, dim=0)
            wi, wo = _directions(family, repeated, generator)
            with torch.no_grad():
                target = _reflected(family, repeated, wi, wo)
            found = _reflected(pbr, network(materials).repeat_interleave(_DIRECTIONS, dim=0), wi, wo)
            # Highlights are thousands of times brighter than the rest; an eye, or a tone curve, compresses them.
            loss = (found.log1p() - target.log1p()).abs().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    with torch.no_grad():
        fitted = torch.cat([network(part) for part in parameters.split(_CHUNK)])
        return fitted, _mean_error(family, parameters, fitted, generator)


class _Regression(nn.Module):
    """From parameters of a family to those of `PbrFamily`; begins at a half rough dielectric of its base colour."""

    def __init__(self, family: MaterialFamily) -> None:
        super().__init__()
        self._family = family
        first, second = nn.Linear(family.num_parameters, _WIDTH), nn.Linear(_WIDTH, _WIDTH)
        last = nn.Linear(_WIDTH, 5)
        self.layers = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last)
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 0.0, -2.0]))

    def forward(self, parameters: Float[Tensor, "T P"]) -> Float[Tensor, "T 5"]:
        base = torch.logit(self._family.base_colour(parameters).detach(), eps=1e-3)
        shifts = self.layers(2 * parameters - 1)
        return torch.cat([base + shifts[:, :3], shifts[:, 3:]], dim=1).sigmoid()


def _reflected(family: MaterialFamily, parameters: Tensor, wi: Tensor, wo: Tensor) -> Tensor:
    """Light that goes to the eye from a direction whose radiance would make a white diffuse surface shine with 1."""
    return torch.pi * family.evaluate(parameters, wi, wo).clamp(min=0) * wi[:, 2:].clamp(min=0)


def _directions(
    family: MaterialFamily, parameters: Float[Tensor, "N P"], generator: torch.Generator
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """To the light and to the eye: the eye anywhere, every other light where the material reflects much."""
    uniforms = torch.rand(len(parameters), 7, generator=generator).to(parameters)
    wo = cosine_directions(uniforms[:, :2].T).T
    spread, towards_lobe = (
        cosine_directions(uniforms[:, 2:4].T).T,
        family.sample(parameters, wo, uniforms[:, 4:]),
    )
    is_lobe = (torch.arange(len(parameters), device=parameters.device) % 2 == 0)[:, None]
    return torch.where(is_lobe, towards_lobe, spread), wo


def _mean_error(
    family: MaterialFamily, parameters: Tensor, fitted: Tensor, generator: torch.Generator
) -> float:
    chosen = torch.randint(len(parameters), (_JUDGED,), generator=generator).to(parameters.device)
    repeated, pbr = (values[chosen].repeat_interleave(_DIRECTIONS, dim=0) for values in (parameters, fitted))
    uniforms = torch.rand(len(repeated), 4, generator=generator).to(repeated)
    wi, wo = cosine_directions(uniforms[:, :2].T).T, cosine_directions(uniforms[:, 2:].T).T
    light = _reflected(family, repeated, wi, wo), _reflected(PbrFamily(), pbr, wi, wo)
    target, found = (one / (1 + one) for one in light)
    return float((found - target).abs().mean() / target.mean().clamp(min=1e-9))
