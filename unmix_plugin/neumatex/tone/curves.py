"""Tone curves by name: what a picture's numbers are of linear light.

Notation: `C` colours, 3 or the bands of a sensor. Light is linear and at least 0; what a curve gives is a picture's
numbers in [0, 1].
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.neumatex.tone.response import CameraResponse
from unmix_plugin.spectral.colour.conversion import agx, linear_to_srgb

ToneMapping = Literal["linear", "srgb", "agx", "camera"]
"""How pictures were made of light: `linear` is light itself, `camera` an unknown response."""
TONE_MAPPINGS: tuple[ToneMapping, ...] = get_args(ToneMapping)
LightCurve = Literal["agx", "srgb", "linear"]
"""Through which pictures of light can be compared."""


class Linear(nn.Module):
    """Numbers that are light; more than 1 is allowed."""

    def forward(self, light: Float[Tensor, "*pixels C"]) -> Float[Tensor, "*pixels C"]:
        """The light itself."""
        return light


class Srgb(nn.Module):
    """Light encoded for an sRGB display, clipped at white."""

    def forward(self, light: Float[Tensor, "*pixels C"]) -> Float[Tensor, "*pixels C"]:
        """Numbers in [0, 1]; no gradient where light is beyond white."""
        return linear_to_srgb(light.clamp(0, 1))


class Agx(nn.Module):
    """Light as AgX encodes it: see `unmix_plugin.spectral.colour.conversion`; RGB only."""

    def forward(self, light: Float[Tensor, "*pixels 3"]) -> Float[Tensor, "*pixels 3"]:
        """Numbers in [0, 1]."""
        return agx(light).clamp(0, 1)


_CURVES: dict[str, type[nn.Module]] = {
    "linear": Linear,
    "srgb": Srgb,
    "agx": Agx,
    "camera": CameraResponse,
}


def tone_curve(name: ToneMapping) -> nn.Module:
    """The curve of that name; only `camera` has parameters."""
    return _CURVES[name]()


def psnr_db(squared_error: Float[Tensor, "*pixels"]) -> Float[Tensor, ""]:
    """Peak signal to noise ratio for a peak of 1; at most 120 dB, nan without pixels."""
    return -10 * torch.log10(squared_error.mean().clamp(min=1e-12))
