"""Pixels of many bands kept as a few numbers each, their components in a subspace.

A pixel that the subspace misses by more than noise can explain, or that is saturated in some band, is kept whole: it
may show what no other shows, and of a saturated value one must know that it is.

Notation: `R` pixels, `b` channels of the sensor.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.scenes.messages import Message
from unmix_plugin.spectral.subspace import find_subspace

Pixels = Int[Tensor, " R"]
Spectra = Float[Tensor, "R b"]
FEWEST_CHANNELS = 100
"""Of a sensor whose pixels are projected without being asked for."""
_LARGEST_SHARE = 0.25
"""Of the memory of whole pixels that projected ones may take for that."""
_LARGEST_RESIDUAL = 2.0
"""In multiples of the noise; of a pixel that is kept whole it is more. Noise alone makes about 1."""
_UNSATURATED = 0.9999
"""Largest value of a pixel that isn't kept whole: 1 stands for a saturated one."""
_WHOLE_RESERVE = 1.2
"""Room on a GPU for pixels that are kept whole, in multiples of what some pixels let expect."""


class Projection:
    """How pixels are projected, and what that leaves."""

    def __init__(self, pixels: Float[Tensor, "N b"], num_components: int | None) -> None:
        """Judged by the even ones of some pixels, of a subspace that the odd ones are in; None finds how many numbers
        are needed. Raises SpectrumError: too few pixels, or too many components."""
        self.subspace = find_subspace(pixels[1::2], num_components)
        seen = pixels[::2]
        stored = self.subspace.components(seen).half()
        residuals = self.subspace.residuals(seen, stored.float())
        is_whole = _must_stay_whole(seen, residuals)
        kept = residuals[~is_whole]
        self.residual = float(kept.square().mean().sqrt()) if len(kept) else float("inf")
        """Root mean square over some pixels that are not kept whole, in multiples of the noise."""
        self.whole_share = float(is_whole.float().mean())
        """Of the pixels, that are kept whole."""

    @property
    def num_channels(self) -> int:
        """b."""
        return self.subspace.basis.shape[1]

    @property
    def pixel_bytes(self) -> float:
        """Memory that a pixel takes in the mean."""
        return 2 * len(self.subspace) + self.whole_share * (2 * self.num_channels + 8)

    def pays(self, whole_bytes: int) -> bool:
        """Whether results stay what they are and pixels need much less memory than `whole_bytes` each."""
        return self.residual <= 1 and self.pixel_bytes <= _LARGEST_SHARE * whole_bytes

    def describe(self) -> str:
        """What a user should know."""
        values = {"kept": len(self.subspace), "channels": self.num_channels}
        values |= {"residual": self.residual, "whole": self.whole_share}
        return Message.KEPT_AS_COMPONENTS.sentence(**values)


class ProjectedPixels:
    """Spectra of a block's pixels by the components that they have in a subspace."""

    def __init__(
        self, projection: Projection, num_pixels: int, device: torch.device, most_bytes: int | None = None
    ) -> None:
        """
        Args:
            num_pixels: Of the block.
            most_bytes: Memory that the values may take; None for what makes a projection pay.
        """
        self._subspace = projection.subspace.to(device)
        halves = torch.empty(0, dtype=torch.float16, device=device)
        self._components = halves.new_empty(num_pixels, len(self._subspace))
        row_bytes = 2 * projection.num_channels + 8
        if most_bytes is None:
            most_bytes = int(_LARGEST_SHARE * num_pixels * 2 * projection.num_channels)
        num_rows = max(0, most_bytes - num_pixels * 2 * len(self._subspace)) // row_bytes
        if device.type != "cpu":
            num_rows = min(num_rows, int(_WHOLE_RESERVE * projection.whole_share * num_pixels) + 1)
        self._room = halves.new_empty(min(num_rows, num_pixels), projection.num_channels)
        """For spectra kept whole. The first rows are in use; what isn't takes no memory on a CPU."""
        self._whole = torch.zeros(0, dtype=torch.int64, device=device)

    @property
    def num_bytes(self) -> int:
        """Memory that the values take."""
        held = (self._components, self._whole, self._room[: len(self._whole)])
        return sum(values.numel() * values.element_size() for values in held)

    def put(self, first: int, spectra: Spectra) -> bool:
        """Keep pixels that follow each other, the first of which has the number `first`; later ones later. False: more
        must be kept whole than there is room for."""
        spectra = spectra.to(self._components.device)
        components = self._subspace.components(spectra).half()
        self._components[first : first + len(spectra)] = components
        residuals = self._subspace.residuals(spectra, components.float())
        whole = _must_stay_whole(spectra, residuals).nonzero()[:, 0]
        before = len(self._whole)
        if before + len(whole) > len(self._room):
            return False
        self._whole = torch.cat([self._whole, first + whole])
        self._room[before : len(self._whole)] = spectra[whole].half()
        return True

    def spectra(self, pixels: Pixels) -> Spectra:
        """Spectra of some pixels in [0, 1]."""
        found = self._subspace.spectra(self._components[pixels].float()).clamp_(0, _UNSATURATED)
        if len(self._whole):
            places = torch.searchsorted(self._whole, pixels.contiguous()).clamp_(max=len(self._whole) - 1)
            rows = (self._whole[places] == pixels).nonzero()[:, 0]
            found[rows] = self._room[places[rows]].float()
        return found


def _must_stay_whole(spectra: Spectra, residuals: Float[Tensor, " R"]) -> Bool[Tensor, " R"]:
    return (residuals > _LARGEST_RESIDUAL) | (spectra.amax(dim=-1) > _UNSATURATED)
