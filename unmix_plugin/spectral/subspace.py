"""Spectra as few numbers: the subspace that all of a scene lie in but for noise, and principal components as colours.

Bands are weighted so that noise is alike in all of them; then the leading eigenvectors of the weighted spectra's second
moments are an orthonormal basis of which no other of its size misses less. There is no mean spectrum: black stays
black, and a pixel half as bright has half the numbers.

Noise is what of each band the others can't tell (Bioucas-Dias and Nascimento 2008).

Notation: `N` spectra, `B` bands, `P` components, `*rays` any leading axes.

Source: J. M. Bioucas-Dias and J. M. P. Nascimento, "Hyperspectral Subspace Identification", IEEE TGRS 46(8), 2008.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import SpectrumError
from unmix_plugin.spectral.evidence import brightness

_FEWEST_SPECTRA = 4
"""That three components need."""
_STRETCH = (0.01, 0.99)
"""Quantiles of a component that become 0 and 1."""
_LEAST_NOISE = 0.005
"""Noise that is assumed at least, as a share of the median brightness: what any model misses is more."""
_SHARE, _SIGMAS_OF_SHARE = 0.95, 1.96
"""Of normal errors, so many are within so many standard deviations; spikes are among the others."""


def estimate_noise(pixels: Float[Tensor, "N B"]) -> Float[Tensor, "N B"]:
    """What of each band the other bands can't predict linearly (Bioucas-Dias and Nascimento 2008, algorithm 1)."""
    data = pixels.double()
    num_bands = data.shape[1]
    correlation = data.T @ data
    # A trace on the diagonal keeps bands that depend on each other exactly from being inverted into infinities.
    trace = 1e-12 * correlation.diagonal().mean().clamp(min=1e-300)
    inverse = torch.linalg.inv(correlation + trace * torch.eye(num_bands).to(data))
    # By the block inverse, row b of the inverse divided by its diagonal holds 1 and minus the coefficients of band b.
    residual = data @ (inverse / inverse.diagonal()[:, None]).T
    return residual.to(pixels.dtype)


@dataclass(frozen=True)
class PcaColours:
    """A map from spectra to three numbers in [0, 1]."""

    mean: Float[Tensor, "B"]
    axes: Float[Tensor, "B 3"]
    """The three directions of largest variance, unit vectors; 0 where there are fewer."""
    low: Float[Tensor, "3"]
    """Components that become 0."""
    high: Float[Tensor, "3"]
    """Components that become 1."""

    @staticmethod
    def fit(spectra: Float[Tensor, "N B"]) -> PcaColours:
        """The map for these spectra: each component is stretched between its 1st and 99th percentile.

        Fewer than four spectra have no components: the map then gives 0.
        """
        num_bands = spectra.shape[1]
        flat = spectra.new_zeros(num_bands, 3)
        if len(spectra) < _FEWEST_SPECTRA:
            return PcaColours(flat[:, 0], flat, flat[0], flat[0])
        mean = spectra.mean(dim=0)
        centred = spectra - mean
        axes = torch.linalg.eigh(centred.T @ centred)[1][:, -3:].flip(-1)
        # The sign of an eigenvector is arbitrary: its largest component is made positive.
        axes = axes * axes.gather(0, axes.abs().argmax(dim=0, keepdim=True)).sign()
        axes = torch.cat([axes, flat[:, axes.shape[1] :]], dim=1)
        low, high = torch.quantile(centred @ axes, torch.tensor(_STRETCH).to(spectra), dim=0)
        return PcaColours(mean, axes, low, high)

    def __call__(self, spectra: Float[Tensor, "*rays B"]) -> Float[Tensor, "*rays 3"]:
        """Colours of spectra."""
        components = (spectra - self.mean) @ self.axes
        return ((components - self.low) / (self.high - self.low).clamp(min=1e-9)).clamp(0, 1)


@dataclass(frozen=True)
class SpectralSubspace:
    """Where the spectra of a scene lie but for noise."""

    weights: Float[Tensor, "B"]
    """Of the bands, in (0, 1]: the least noise of a band over its own."""
    basis: Float[Tensor, "P B"]
    """Orthonormal rows, of weighted bands."""
    noise: float
    """Standard deviation of the noise in every weighted band."""

    def __len__(self) -> int:
        return len(self.basis)

    def to(self, device: torch.device) -> SpectralSubspace:
        """The same on a device."""
        return SpectralSubspace(self.weights.to(device), self.basis.to(device), self.noise)

    def components(self, spectra: Float[Tensor, "N B"]) -> Float[Tensor, "N P"]:
        """Spectra as sums of the basis; of spectra in [0, 1] none is larger than the root of B."""
        return (spectra * self.weights) @ self.basis.T

    def spectra(self, components: Float[Tensor, "N P"]) -> Float[Tensor, "N B"]:
        """The spectra that components stand for."""
        return components @ (self.basis / self.weights)

    def residuals(
        self, spectra: Float[Tensor, "N B"], components: Float[Tensor, "N P"]
    ) -> Float[Tensor, "N"]:
        """What components miss of spectra: root mean square over weighted bands, in multiples of the noise."""
        missed = torch.addmm(spectra, components, self.basis / -self.weights).mul_(self.weights)
        return torch.linalg.vector_norm(missed, dim=-1) / (missed.shape[1] ** 0.5 * self.noise)


def find_subspace(pixels: Float[Tensor, "N B"], num_components: int | None = None) -> SpectralSubspace:
    """The subspace of a scene's pixels, background left out.

    Args:
        num_components: P; None takes the fewest components that miss no more than the noise.
    Raises:
        SpectrumError: not more pixels than bands, or more components than bands.
    """
    num_pixels, num_bands = pixels.shape
    if num_pixels <= num_bands or (num_components is not None and not 1 <= num_components <= num_bands):
        asked = "any components" if num_components is None else f"{num_components} components"
        raise SpectrumError(
            f"a subspace of {asked} needs 1 to as many components as bands, and more pixels than bands; found "
            f"{num_pixels} pixels of {num_bands} bands"
        )
    least = max(_LEAST_NOISE * float(brightness(pixels).median()), 1e-6)
    rank = max(1, round(_SHARE * num_pixels))
    sigmas = estimate_noise(pixels).abs().kthvalue(rank, dim=0).values.double() / _SIGMAS_OF_SHARE
    sigmas = sigmas.clamp(min=least)
    noise = float(sigmas.min())
    weights = noise / sigmas
    weighted = pixels.double() * weights
    strengths, vectors = torch.linalg.eigh(weighted.T @ weighted / num_pixels)
    missed = strengths.cumsum(0).flip(0) - strengths.flip(0)  # with one component, with two, ...
    if num_components is None:
        num_components = int((missed > num_bands * noise**2).sum()) + 1
    basis = vectors.flip(1)[:, :num_components].T
    return SpectralSubspace(weights.float(), basis.contiguous().float(), noise)
