"""The endmembers of two captures as one list, in the light of the first.

Notation: `B` bands, `K` endmembers of the first, `L` of the second, `J` of both together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64

from unmix_plugin.spectral.metrics import match_endmembers
from unmix_plugin.spectral.unmixing.abundances import nnls

SAME_MATERIAL = 0.1
"""Spectral angle (rad), light taken out, up to which two endmembers are one material."""
_THERE = 0.01
"""Mean abundance from which a material is on a surface."""


@dataclass(frozen=True, eq=False)
class JoinedMaterials:
    """Materials of both captures, each once: those of the first, then those that only the second has."""

    names: tuple[str, ...]
    spectra: Float64[np.ndarray, "J B"]
    pairs: tuple[tuple[str, str, float], ...]
    """Names of one material in the first and in the second capture, and the angle (rad) between the two."""
    vanished: tuple[str, ...]
    """On the first surface only."""
    new: tuple[str, ...]
    """On the second surface only."""

    def in_words(self) -> str:
        """What became of the materials, for people."""
        text = f"{len(self.pairs)} of the materials are in both captures"
        text += f"; new: {', '.join(self.new)}" if self.new else ""
        return text + (f"; vanished: {', '.join(self.vanished)}" if self.vanished else "")

    def abundances(self, spectra: Float32[np.ndarray, "V P B"]) -> Float32[np.ndarray, "V P J"]:
        """Abundances, summing to 1, of spectra in the light of the first capture; NaN where these are."""
        known = np.isfinite(spectra).all(axis=-1)
        found = np.full((*spectra.shape[:-1], len(self.spectra)), np.nan, np.float32)
        amounts = nnls(torch.from_numpy(spectra[known]).double(), torch.from_numpy(self.spectra)).numpy()
        found[known] = amounts / amounts.sum(axis=-1, keepdims=True).clip(min=1e-9)
        return found


def join_materials(
    before: tuple[tuple[str, ...], Float[np.ndarray, "K B"], Float[np.ndarray, " K"]],
    after: tuple[tuple[str, ...], Float[np.ndarray, "L B"], Float[np.ndarray, " L"]],
) -> JoinedMaterials:
    """Join names, spectra in one light and mean abundances on the surface of two captures.

    Endmembers are paired so that angles are least in all; a pair that is too far apart is two materials.
    """
    (names, spectra, amounts), (later_names, later_spectra, later_amounts) = before, after
    found = match_endmembers(torch.from_numpy(later_spectra), torch.from_numpy(spectra))
    pairs = [
        (first, second, angle)
        for first, second, angle in zip(found.true_ids, found.pred_ids, found.angles, strict=True)
        if angle <= SAME_MATERIAL
    ]
    firsts, seconds = {one[0] for one in pairs}, {one[1] for one in pairs}
    added = [index for index in range(len(later_names)) if index not in seconds]
    joined = list(names)
    for index in added:
        name = later_names[index]
        joined.append(name if name not in joined else f"{name} (after)")
    return JoinedMaterials(
        tuple(joined),
        np.concatenate([spectra, later_spectra[added]]).astype(np.float64),
        tuple((names[first], later_names[second], angle) for first, second, angle in pairs),
        tuple(name for index, name in enumerate(names) if index not in firsts and amounts[index] >= _THERE),
        tuple(joined[len(names) + row] for row, index in enumerate(added) if later_amounts[index] >= _THERE),
    )
