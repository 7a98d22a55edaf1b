"""The endmembers that a training starts from, and how they guide abundances.

They come from a file or are found in the training pixels. The model keeps the first ones: pixels are unmixed with them
one by one, and abundances are drawn to what is found. A rendered spectrum is never exact, and where endmembers resemble
mixtures of each other a small error in a spectrum is a large one in its mixture. Measured spectra are the better
witnesses; a field that must agree with all of them takes the mean over views, in which noise and highlights that wander
over a surface lose.

Notation: `N` and `R` pixels, `K` endmembers, `B` bands of the scene, `b` channels of a sensor of a rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from threading import Lock

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize

from unmix_plugin.sensors.views import BandBalance, SensorViews
from unmix_plugin.settings import UnmixModelConfig
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.unmixing.abundances import nnls, sparse_abundances
from unmix_plugin.spectral.unmixing.endmembers import (
    distinct_spectra,
    drop_uninformative_pixels,
    fill_bands,
    given_endmembers,
    initialise_endmembers,
)
from unmix_plugin.spectral.unmixing.two_material_mixtures import mean_pair_distance

_OBSERVED_PIXELS = 256
"""Pixels of a batch by which the error of margins is followed."""
_RELATIVE_PENALTY = 5.0
"""By how much a further material must improve the fit of a spectrum, in multiples of what all materials improve that of
the pixels beyond mixtures of two. Of landscapes, this is the most that costs 3 % of their abundance error."""
_CLEAR_GAIN = 0.01
"""Smallest mean improvement, in radians, at which that multiple counts in full; below it falls in proportion."""
_CLEAR_MARGIN = 0.9
"""Nearly pure pixels, whose margin is larger, hardly err, and would hide what the others do."""
_DECAY = 0.99
_CACHE_BYTES = 1 << 26
_CACHE = Lock()
"""Batches that are worked on at once share what is kept of pixels."""
_SHARED_ERROR = 2.0
"""Variance of a margin's error in multiples of that of field against pixels: errors of both cancel in it."""


class AbundanceGuide(nn.Module):
    """The first endmembers, with which pixels are unmixed one by one, and how far the field is from the result."""

    endmembers: Tensor
    penalty: Tensor
    margin_variance: Tensor

    def __init__(self, num_endmembers: int, num_bands: int) -> None:
        super().__init__()
        self.register_buffer("endmembers", torch.zeros(num_endmembers, num_bands))
        self.register_buffer("penalty", torch.zeros(()))
        self.register_buffer("margin_variance", torch.full((), torch.inf))
        self._keys = torch.zeros(0, dtype=torch.int64)
        self._mixtures = torch.zeros(0, num_endmembers, dtype=torch.float16)

    @property
    def margin_error(self) -> Float[Tensor, ""]:
        """Standard error of the margin of a ray's largest abundance over its second; infinite before any training."""
        return (_SHARED_ERROR * self.margin_variance).sqrt()

    def start(
        self, pixels: Float[Tensor, "N b"], endmembers: Float[Tensor, "K B"], seen: Float[Tensor, "K b"]
    ) -> None:
        """Unmix with these endmembers, `seen` as the pixels are, from now on."""
        self.endmembers.copy_(endmembers)
        self.penalty.fill_(mixing_penalty(pixels, seen))

    def update(
        self, abundances: Float[Tensor, "R K"], mixtures: Float[Tensor, "R K"], counts: Bool[Tensor, "R"]
    ) -> None:
        """Follow how far margins of composited abundances are from those of measured `mixtures`, by opaque pixels that
        count."""
        if abundances.shape[1] == 1:
            return
        few = slice(_OBSERVED_PIXELS)
        largest, mixtures, counts = abundances[few].detach().topk(2, dim=1), mixtures[few], counts[few]
        margins = largest.values[:, 0] - largest.values[:, 1]
        first, second = mixtures.gather(1, largest.indices).unbind(1)
        counts = counts & (margins < _CLEAR_MARGIN)
        errors = torch.where(counts, (margins - first + second).square(), 0.0)
        variance, before = errors.sum() / counts.sum().clamp(min=1), self.margin_variance
        moved = torch.where(before.isinf(), variance, before.lerp(variance, 1 - _DECAY))
        # Without any such pixel, or where the field is not finite, it stays as it is.
        self.margin_variance.copy_(torch.where((counts.sum() > 0) & variance.isfinite(), moved, before))

    @torch.no_grad()
    def unmix(
        self, pixels: Int[Tensor, "R"], spectra: Float[Tensor, "R b"], endmembers: Float[Tensor, "K b"]
    ) -> Float[Tensor, "R K"]:
        """Abundances of pixels by their numbers and measured spectra, summing to 1, as mixtures of few of the guide's
        endmembers as their sensor sees them; a spectrum's brightness does not matter.

        A mixture depends on the pixel alone, and pixels come again, so those that were unmixed recently are kept: in a
        fixed number of slots, whatever the size of the scene. Values are kept, and given even the first time, in half
        precision, so that a resumed training sees the same ones.
        """
        with _CACHE:
            if len(self._keys) == 0:
                num_endmembers, device = len(self.endmembers), self.endmembers.device
                num_slots = min(1 << 20, _CACHE_BYTES // (2 * num_endmembers))
                self._keys = torch.full((num_slots,), -1, dtype=torch.int64, device=device)
                self._mixtures = torch.zeros(num_slots, num_endmembers, dtype=torch.float16, device=device)
            slots = pixels % len(self._keys)
            is_new = (self._keys[slots] != pixels).nonzero()[:, 0]
            values = self._mixtures[slots]
        if len(is_new):
            values[is_new] = sparse_abundances(spectra[is_new], endmembers, self.penalty).to(values)
            with _CACHE:
                self._keys[slots[is_new]] = pixels[is_new]
                # Two pixels of a batch may share a slot; only one of them has it in the end.
                kept = is_new[self._keys[slots[is_new]] == pixels[is_new]]
                self._mixtures[slots[kept]] = values[kept]
        return values.to(spectra)


def mixing_penalty(pixels: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"]) -> float:
    """By how many radians a further material must improve the fit of a spectrum to count, from all training pixels.

    It follows what all endmembers explain of the pixels beyond mixtures of two, by the square up to 0.01 and in
    proportion from there: much where surfaces tint each other's light, and the tints would count as materials; little
    where noise, or spectra that vary from place to place, leave the same angle.
    """
    informative = normalize(drop_uninformative_pixels(pixels), dim=1)
    corners = normalize(endmembers.to(pixels), dim=1)
    residuals = (informative - nnls(informative, corners) @ corners).norm(dim=1).double()
    unexplained = residuals.sum() / max(1, len(informative))
    gain = max(0.0, mean_pair_distance(informative, corners) - float(unexplained))
    return _RELATIVE_PENALTY * min(gain / _CLEAR_GAIN, 1.0) * gain


def first_endmembers(
    config: UnmixModelConfig,
    initial_data: Mapping[str, np.ndarray],
    generator: torch.Generator,
    *,
    count: int,
    balance: BandBalance,
    sensors: SensorViews,
    lamp: Float[Tensor, "B"],
    bands: Bands,
) -> Float[Tensor, "K B"]:
    """The first K = `count` endmembers, on all bands; reflectances of a file are multiplied by the lamp's spectrum.

    Raises:
        SpectrumError: more endmembers than distinct pixels, or spectra that don't cover the bands.
        ConfigError: the file has another number of spectra.
    """
    pixels, sensor = torch.from_numpy(initial_data["pixels"]), initial_data.get("sensor")
    if config.endmember_file is not None:
        everywhere = pixels if sensor is None else _on_all_bands(pixels, sensors, initial_data)
        return given_endmembers(config.endmember_file, count, bands, lamp, everywhere, generator)
    assert config.endmember_init != "file"
    if not sensors.tells_materials(sensor, count):
        return distinct_spectra(torch.from_numpy(initial_data["typical"]), count)
    balanced = balance.scaled(pixels, sensor)
    seen = balance.restored(initialise_endmembers(balanced, count, config.endmember_init, generator), sensor)
    return seen if sensor is None else _on_all_bands(seen, sensors, initial_data)


def first_specular_spectra(
    count: int, lamp: Float[Tensor, "B"], endmembers: Float[Tensor, "K B"]
) -> Float[Tensor, "count B"]:
    """The specular dictionary at the start: the lamp's spectrum, then the endmembers in turn."""
    rows = [lamp if row == 0 else endmembers[(row - 1) % len(endmembers)] for row in range(count)]
    return torch.stack(rows) if rows else endmembers[:0]


def _on_all_bands(
    seen: Float[Tensor, "N b"], sensors: SensorViews, initial_data: Mapping[str, np.ndarray]
) -> Float[Tensor, "N B"]:
    matrix = sensors.matrix(initial_data["sensor"]).cpu()
    return fill_bands(seen, matrix, torch.from_numpy(initial_data["typical"]))
