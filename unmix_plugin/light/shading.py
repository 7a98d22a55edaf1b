"""How surfaces look: small networks, functions of directions, and shading in the light of a lamp whose place is known.

A lit surface is matt, with a specular highlight where it mirrors the lamp:

    s(x, d) = sigmoid(s_0 + ...) (r + (1 - r) V max(0, n . l))          matt (Lambert), r from all around
    t_k(x, d) = V exp(-m_k (1 - (n . h)^2))                             specular, h halfway between l and the eye

The normal n is learnt from what the light does, with r: a lamp that moves shows normals better than thin densities do.
All places of a material mirror alike around their normals, so that few highlights tell where others will be.

What of a lamp's light gets past what stands in its way is looked up in a grid of opaque cells, for two points beside
the lamp's middle: the mean of both is a soft shadow, and their difference tells training where to move the lamp.

Notation: `S` samples, `R` rays, `X Y Z` cells of a grid over the scene box, `F` inputs and `O` outputs of a network,
`G` geometry features; l the direction to the lamp, V the visible part of its light.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import normalize

from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.light.lamp import MovingLamp
from unmix_plugin.operators.marching import rays_in_box

Vectors = Float[Tensor, "S 3"]
Values = Float[Tensor, "S"]
Column = Float[Tensor, "S 1"]
Skips = UInt8[Tensor, "X Y Z"]

NUM_DIRECTION_FEATURES = 15


def direction_features(directions: Vectors) -> Float[Tensor, "S 15"]:
    """Real spherical harmonics of degrees 1 to 3 of unit directions (the constant carries nothing), up to scale."""
    x, y, z = directions.t().contiguous()  # rows: arithmetic on columns takes twice as long
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            x,
            y,
            z,
            1.7320508 * x * y,
            1.7320508 * y * z,
            0.5 * (3 * zz - 1),
            1.7320508 * x * z,
            0.8660254 * (xx - yy),
            0.7905694 * y * (3 * xx - yy),
            3.8729833 * x * y * z,
            0.6123724 * y * (5 * zz - 1),
            0.5 * z * (5 * zz - 3),
            0.6123724 * x * (5 * zz - 1),
            1.9364917 * z * (xx - yy),
            0.7905694 * x * (xx - 3 * yy),
        ]
    ).t()


_SKY_OCTAVES = 4
NUM_SKY_FEATURES = NUM_DIRECTION_FEATURES + 6 * _SKY_OCTAVES


def sky_features(directions: Float[Tensor, "R 3"]) -> Float[Tensor, "R 39"]:
    """Harmonics of unit directions, and sines and cosines of 1, 2, 4 and 8 times their components."""
    return torch.cat([direction_features(directions), _waves(directions)], dim=-1)


NUM_BACKDROP_FEATURES = NUM_SKY_FEATURES + 3 + 4 * _SKY_OCTAVES


def backdrop_features(rays: RayBundle) -> Float[Tensor, "R 58"]:
    """Those of a sky, and what a backdrop at hand depends on too: where it is seen from, as it is not infinitely far
    away, and where in the picture, as it can stand still there and lenses show less light towards the sides. Neither
    tells how a camera or a lens is to be corrected."""
    offsets = rays.directions.new_zeros(len(rays), 2) if rays.offsets is None else rays.offsets
    return torch.cat([sky_features(rays.directions), rays.origins.detach(), _waves(offsets.detach())], dim=-1)


def _waves(values: Float[Tensor, "R n"]) -> Float[Tensor, "R _"]:
    """Sines and cosines of 1, 2, 4 and 8 times each value."""
    angles = torch.cat([2.0**octave * values for octave in range(_SKY_OCTAVES)], dim=-1)
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


_CACHED_ROWS = 4096
"""Samples of which a hidden layer stays in a core's cache."""


def bias_free_network(*widths: int) -> nn.Sequential:
    """Linear layers from each width to the next, with a ReLU between them."""
    # Without biases, as in Mueller et al. 2022: torch copies a bias into the output first, a fifth of the layer's time.
    layers: list[nn.Module] = []
    for num_inputs, num_outputs in pairwise(widths):
        layers += [nn.Linear(num_inputs, num_outputs, bias=False), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers[:-1])


def rows_of_outputs(network: nn.Sequential, *inputs: Float[Tensor, "S _"]) -> Float[Tensor, "O S"]:
    """What a bias-free network gives, an output a row: products with few columns take twice as long. Its inputs come
    side by side, as joining them would cost time."""
    first, *inner, last = network
    assert isinstance(first, nn.Linear)
    assert isinstance(last, nn.Linear)
    weights = first.weight.split([values.shape[1] for values in inputs], dim=1)
    found = []
    for part, *others in _parts(*inputs):
        hidden = part @ weights[0].t()
        for values, weight in zip(others, weights[1:], strict=True):
            hidden.addmm_(values, weight.t())
        for layer in inner:
            hidden = layer(hidden)
        found.append(last.weight @ hidden.t())
    return found[0] if len(found) == 1 else torch.cat(found, dim=1)


def in_parts(network: nn.Sequential, inputs: Float[Tensor, "S F"]) -> Float[Tensor, "S O"]:
    """What a network gives of samples, as `_parts` has them."""
    found = [network(part) for (part,) in _parts(inputs)]
    return found[0] if len(found) == 1 else torch.cat(found)


def _parts(*values: Float[Tensor, "S _"]) -> Sequence[tuple[Float[Tensor, "_ _"], ...]]:
    """The same rows of all; without gradients few at a time, so that a hidden layer of them stays in the cache."""
    # As many for each thread: they wait for one another after every part.
    at_once = _CACHED_ROWS * torch.get_num_threads()
    if torch.is_grad_enabled() or len(values[0]) <= at_once:
        return [values]
    return list(zip(*(each.split(at_once) for each in values), strict=True))


LOBES = (8.0, 32.0, 128.0, 512.0)
"""m_k: the last is half as high where the normal is 2 degrees off."""
_FIRST_NORMAL = 0.1
"""Length of the untrained normal before it gets length 1: gradients of shorter ones would outweigh all others."""


@dataclass(frozen=True)
class Lamplight:
    """What of a lamp's light reaches samples."""

    visible: Values
    """The part that nothing stands in the way of, in [0, 1]."""
    towards: Vectors
    """Unit directions to the lamp."""


@dataclass(frozen=True)
class LitSurface:
    """How samples look in a lamp's light."""

    brightness: Column
    """Of a matt surface, in [0, 1]: 1 where the lamp shines on it head-on."""
    lobes: Float[Tensor, "S 4"]
    """How well each of `LOBES` mirrors the lamp to the eye."""


class LampShading(nn.Module):
    """Learnt normals, and how much of the light comes from all around."""

    first_normal: Tensor

    def __init__(self, num_features: int, width: int, upwards: Float[Tensor, "3"]) -> None:
        """Of G features, with so wide a hidden layer and normals that are all near a unit vector `upwards` at first."""
        super().__init__()
        self.register_buffer("first_normal", _FIRST_NORMAL * upwards, persistent=False)
        self.network = bias_free_network(num_features, width, 4)

    def surface(self, features: Float[Tensor, "S G"]) -> tuple[Vectors, Column]:
        """Unit normals in model space, and r."""
        raw = self.network(features)
        return normalize(raw[:, :3] + self.first_normal, dim=1), torch.sigmoid(raw[:, 3:])

    def forward(self, features: Float[Tensor, "S G"], directions: Vectors, light: Lamplight) -> LitSurface:
        """How samples look along unit directions."""
        normals, around = self.surface(features)
        cosine = _bounded_below((normals * light.towards).sum(dim=1, keepdim=True))
        visible = light.visible[:, None]
        halfway = normalize(light.towards - directions, dim=1)
        away = 1 - (normals * halfway).sum(dim=1, keepdim=True).clamp(min=0).square()
        lobes = visible * torch.exp(-away * away.new_tensor(LOBES))
        return LitSurface(around + (1 - around) * visible * cosine, lobes)


def _bounded_below(cosine: Column) -> Column:
    """max(0, cosine) in value only: a surface that is wrongly turned away from the lamp can still turn back."""
    return cosine + (cosine.clamp(min=0) - cosine).detach()


@dataclass(frozen=True)
class ShadowDetail:
    """How sharp shadows are. Surfaces are thick while they form, and so are their shadows."""

    clear_cells: float
    """Way from a place towards the lamp, in cells, that casts no shadow: a surface would else lie in its own."""
    dark_cells: float
    """Opaque cells on the way to the lamp that leave 1 / e of its light."""
    spread: float
    """Standard deviation of the points beside the lamp's middle along each axis, in its distance."""

    @staticmethod
    def at(progress: float) -> ShadowDetail:
        """When that part of the training is over, from 0 to 1; each number changes by equal factors."""
        ends = zip(astuple(_FIRST), astuple(FINEST), strict=True)
        return ShadowDetail(*(first * (last / first) ** progress for first, last in ends))


_FIRST = ShadowDetail(clear_cells=8.0, dark_cells=5.0, spread=0.05)
FINEST = ShadowDetail(clear_cells=3.0, dark_cells=2.0, spread=0.02)
"""At the end of training, and in renders."""
_PITCH_DARK = 64
"""Opaque cells on the way of light from which on nothing passes in float32, so that more needn't be counted."""
_SHADOWS_AT_ONCE = 1 << 16
"""Positions whose samples towards the lamp are held together: 16 MB."""


def lamplight(
    lamp: MovingLamp,
    origins: Vectors,
    positions: Vectors,
    box: SceneBox,
    skips: Skips,
    detail: ShadowDetail = FINEST,
    generator: torch.Generator | None = None,
) -> Lamplight:
    """What of a lamp's light reaches samples of rays from `origins`.

    Only the visible part is differentiable in the lamp's place: shading would move it to where wrong normals want it.
    Cells whose `skips` are 0 cast shadows, in others it is what `skip_distances` says. A generator draws two points
    beside the lamp's middle for each sample; None takes four fixed ones.
    """
    origins, positions = origins.detach(), positions.detach()
    middle = lamp.positions(origins)
    fixed, spread = middle.detach(), detail.spread * float(lamp.first_place.norm())
    towards = normalize(fixed - positions, dim=-1)
    if generator is None:
        corners = spread * positions.new_tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
        parts = [visible_part(positions, fixed + corner, box, skips, detail) for corner in corners]
        return Lamplight(torch.stack(parts).mean(dim=0), towards)
    drawn = torch.randn(positions.shape, generator=generator, device=generator.device)
    offsets = spread * drawn.to(positions)
    one, other = (visible_part(positions, fixed + shift, box, skips, detail) for shift in (offsets, -offsets))
    # Stein's identity: the mean of these slopes is the gradient of the visible part, blurred over the points.
    slopes = ((one - other) / (2 * spread**2))[:, None] * offsets
    return Lamplight((one + other) / 2 + (slopes * (middle - fixed)).sum(dim=-1), towards)


@torch.no_grad()
def visible_part(
    positions: Vectors, lamps: Vectors, box: SceneBox, skips: Skips, detail: ShadowDetail = FINEST
) -> Values:
    """Part of the light from points outside the box that the box lets through to each position."""
    if len(positions) > _SHADOWS_AT_ONCE:
        parts = zip(positions.split(_SHADOWS_AT_ONCE), lamps.split(_SHADOWS_AT_ONCE), strict=True)
        return torch.cat([visible_part(*part, box, skips, detail) for part in parts])
    towards = normalize(lamps - positions, dim=-1)
    cell = float((box.size / torch.tensor(skips.shape, device=box.size.device)).max())
    t_far = box.intersect(positions, towards)[1]
    t_near = torch.full_like(t_far, detail.clear_cells * cell)
    lines, middles = (box.normalise(positions), towards / box.size), torch.full_like(t_far, 0.5)
    counts = rays_in_box(*lines, t_near, t_far, middles, skips, cell).first_samples(_PITCH_DARK).counts
    return torch.exp(-(counts / detail.dark_cells).square())
