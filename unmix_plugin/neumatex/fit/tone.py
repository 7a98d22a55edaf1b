"""From linear light to the numbers of a picture, and to numbers that are compared or shown.

A camera's response is learnt with the materials. It is given by the logarithm of its slope, which is a mean and a few
principal components; so whatever the coefficients are, it increases from 0 to 1. The components come from a family of
curves made here (powers, logarithms, S-shaped ones), since the measured curves of Grossberg and Nayar (2004, EMoR)
can't be shipped with this package.

Notation: `C` colours, 3 or the bands of a sensor, `B` bands. Light is linear and at least 0; what a curve gives is a
picture's numbers in [0, 1]. `S` steps of the response, `F` curves of the family, `K` coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import agx, linear_to_srgb, rgb_matrix

NUM_STEPS, NUM_COEFFICIENTS = 256, 6
_MAX_STOPS = 8.0
"""Exposure that can be learnt, either way."""
ToneMapping = Literal["linear", "srgb", "agx", "camera"]
"""How pictures were made of light: `linear` is light itself, `camera` an unknown response."""
LightCurve = Literal["agx", "srgb", "linear"]
"""Through which pictures of light can be compared."""
_DARK = 0.25
"""Brightness, as a part of the mean, far below which pixels count alike."""


class CameraResponse(nn.Module):
    """One increasing curve for all colours, and the exposure before it."""

    mean: Tensor
    components: Tensor

    def __init__(self) -> None:
        super().__init__()
        mean, components = _response_basis()
        self.register_buffer("mean", mean.clone())
        self.register_buffer("components", components.clone())
        self.coefficients = nn.Parameter(torch.zeros(NUM_COEFFICIENTS))
        self.exposure_stops = nn.Parameter(torch.zeros(()))

    def forward(self, light: Float[Tensor, "*pixels C"]) -> Float[Tensor, "*pixels C"]:
        """Numbers in [0, 1] of linear light; no gradient where light is beyond white."""
        stops = self.exposure_stops.clamp(-_MAX_STOPS, _MAX_STOPS)
        exposed = (light * torch.exp2(stops)).clamp(1e-8, 1)
        increments = (self.mean + self.coefficients @ self.components).softmax(dim=0)
        # The response at (i / S)^2 of full exposure, from 0 to 1.
        curve = torch.cat([increments.new_zeros(1), increments.cumsum(dim=0)])
        place = exposed.sqrt() * NUM_STEPS
        step = place.detach().long().clamp(max=NUM_STEPS - 1)
        low, high = (step / NUM_STEPS).square(), ((step + 1) / NUM_STEPS).square()
        part = (exposed - low) / (high - low)
        return curve[step] + (curve[step + 1] - curve[step]) * part


@lru_cache(maxsize=1)
def _response_basis() -> tuple[Float[Tensor, " S"], Float[Tensor, "K S"]]:
    """Mean and principal components of the logarithm of the steps of all curves of the family, each scaled by its
    spread, so that coefficients of about 1 are usual."""
    logs = _curve_family().diff(dim=1).clamp(min=1e-12).log()
    mean = logs.mean(dim=0)
    _, spreads, axes = torch.linalg.svd(logs - mean, full_matrices=False)
    scale = spreads[:NUM_COEFFICIENTS, None] / len(logs) ** 0.5
    return mean.float(), (scale * axes[:NUM_COEFFICIENTS]).float()


def _curve_family() -> Float[Tensor, "F S_plus_1"]:
    """Responses at (i / S)^2 of full exposure, float64: powers, logarithms, S-shaped ones, and powers of these."""
    light = torch.linspace(0, 1, NUM_STEPS + 1, dtype=torch.float64).square()
    gammas = torch.linspace(0.3, 1.4, 12, dtype=torch.float64)
    bends = torch.logspace(-0.5, 2.5, 10, dtype=torch.float64)
    steepness = torch.linspace(0.7, 1.8, 6, dtype=torch.float64)
    middles = torch.tensor([0.1, 0.18, 0.3, 0.5, 1.0], dtype=torch.float64)
    powers = [light**gamma for gamma in gammas]
    logs = [
        (torch.log1p(bend * light) / torch.log1p(bend)) ** gamma for bend in bends for gamma in gammas[3:9:2]
    ]
    shaped = [light**n / (light**n + middle**n) * (1 + middle**n) for n in steepness for middle in middles]
    return torch.stack([*powers, *logs, *shaped])


TONE_MAPPINGS: tuple[ToneMapping, ...] = get_args(ToneMapping)


class _FixedCurve(nn.Module):
    """A tone curve without parameters."""

    def __init__(self, name: ToneMapping) -> None:
        super().__init__()
        self._name = name

    def forward(self, light: Float[Tensor, "*pixels C"]) -> Float[Tensor, "*pixels C"]:
        """Numbers in [0, 1], but of `linear`; no gradient where light is beyond white."""
        if self._name == "linear":
            return light
        return agx(light).clamp(0, 1) if self._name == "agx" else linear_to_srgb(light.clamp(0, 1))


def tone_curve(name: ToneMapping) -> nn.Module:
    """The curve of that name; only `camera` has parameters."""
    return CameraResponse() if name == "camera" else _FixedCurve(name)


def psnr_db(squared_error: Float[Tensor, "*pixels"]) -> Float[Tensor, ""]:
    """Peak signal to noise ratio for a peak of 1; at most 120 dB, nan without pixels."""
    return -10 * torch.log10(squared_error.mean().clamp(min=1e-12))


class LampRatio(nn.Module):
    """Light over the lamp's power, so that all bands count by their reflectance; above 1 its logarithm, plus 1, so that
    highlights do not outweigh everything else.

    It is straight where nearly all light is: a curve that bends makes noisy estimates look too dark on average, and
    materials, dark ones most, would be fitted too bright.
    """

    lamp: Tensor

    def __init__(self, lamp: Sequence[float]) -> None:
        """For a lamp of this power in each band, above 0."""
        super().__init__()
        self.register_buffer("lamp", torch.tensor(lamp, dtype=torch.float32), persistent=False)

    def forward(self, light: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels B"]:
        """Numbers of at least 0."""
        ratio = light / self.lamp
        return torch.where(ratio < 1, ratio, 1 + ratio.clamp(min=1).log())

    def weights(self, light: Float[Tensor, "R B"]) -> Float[Tensor, "R 1"]:
        """Of errors of a picture's pixels, so that relative errors count, but in those far darker than the mean, which
        hold little but noise. They follow from the picture alone, so that the noise of rendered light makes no bias;
        the mean of their squares is 1."""
        brightness = (light / self.lamp).mean(dim=-1, keepdim=True).clamp(min=0)
        weights = 1 / (_DARK * brightness.mean().clamp(min=1e-6) + brightness)
        return weights / weights.square().mean().sqrt()


class SpectralDisplay(nn.Module):
    """Spectra as AgX shows their colour; the flat spectrum 1 is white."""

    matrix: Tensor

    def __init__(self, bands: Bands) -> None:
        """For spectra of these bands."""
        super().__init__()
        self.register_buffer("matrix", rgb_matrix(bands), persistent=False)

    def rgb(self, spectra: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels 3"]:
        """Linear colour, at least 0."""
        return (spectra @ self.matrix).clamp(min=0)

    def forward(self, light: Float[Tensor, "*pixels B"]) -> Float[Tensor, "*pixels 3"]:
        """sRGB numbers in [0, 1]."""
        return agx(self.rgb(light)).clamp(0, 1)
