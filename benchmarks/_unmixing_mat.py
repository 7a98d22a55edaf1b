"""Images with true abundances in .mat files, as people who unmix exchange them, and how methods score on them.

Notation: `N` pixels, `B` bands, `K` materials.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from _unmixing_methods import PixelMethod, find_endmembers
from scipy.io import loadmat
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from unmix_plugin.errors import SceneError
from unmix_plugin.spectral.metrics import spectral_angle

_LIT = 0.9
"""Value that the 99.9th percentile of the pixels' peaks is scaled to, so that few count as saturated."""


class PixelImage:
    """Pixels with true abundances and endmembers."""

    def __init__(self, pixels: Tensor, abundances: Tensor, endmembers: Tensor) -> None:
        """
        Args:
            pixels: (N, B), in any unit.
            abundances: (N, K).
            endmembers: (K, B), each of any brightness.
        """
        brightest = pixels.amax(dim=1).quantile(0.999).clamp(min=1e-300)
        self._pixels = (pixels * (_LIT / brightest)).clamp(min=0).float()
        self._abundances, self._endmembers = abundances.double(), endmembers.float()
        self._found: dict[tuple[str, int], Tensor] = {}

    @property
    def num_materials(self) -> int:
        return len(self._endmembers)

    def score(self, method: PixelMethod, seed: int) -> dict[str, float]:
        """Abundance RMSE and mean endmember angle in radians, after matching by angle.

        Raises:
            SpectrumError: the method can't find so many endmembers.
        """
        endmembers = self._endmembers_by(method.find, seed)
        angles = spectral_angle(self._endmembers[:, None].double(), endmembers[None].double())
        true, found = linear_sum_assignment(angles.numpy())
        amounts = method.explainer(self._pixels, endmembers)(self._pixels, endmembers).double()
        shares = amounts / amounts.sum(dim=1, keepdim=True).clamp(min=1e-12)
        rmse = (shares[:, found] - self._abundances).square().mean().sqrt()
        return {"abundance_rmse": float(rmse), "endmember_angle": float(angles[true, found].mean())}

    def _endmembers_by(self, find: str, seed: int) -> Tensor:
        if find == "truth":
            return self._endmembers
        if (find, seed) not in self._found:
            generator = torch.Generator().manual_seed(seed)
            self._found[find, seed] = find_endmembers(self._pixels, self.num_materials, find, generator)
        return self._found[find, seed]


def read_mat(path: Path) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (N, B), abundances (N, K) and endmembers (K, B), in float64.

    Raises:
        SceneError: no .mat file of version 4 to 7, a missing key, wrong shapes, or values that are not finite.
    """
    try:
        content = loadmat(path)
    except Exception as error:  # scipy raises errors of many kinds at files of another format
        raise SceneError(
            f"{path} can't be read as a .mat file of version 4 to 7: {' '.join(str(error).split())}"
        ) from error
    missing = [key for key in ("Y", "A", "M") if key not in content]
    if missing:
        keys = ", ".join(key for key in content if not key.startswith("__"))
        raise SceneError(f"{path} has no {missing[0]!r}; found {keys or 'nothing'}; it needs Y, A and M")
    pixels, abundances, endmembers = (_matrix(content[key], key, path) for key in ("Y", "A", "M"))
    if len(endmembers) > endmembers.shape[1]:
        endmembers = endmembers.T
    count, num_bands = endmembers.shape
    if len(abundances) == count != abundances.shape[1]:
        abundances = abundances.T
    num_pixels = len(abundances)
    if pixels.shape != (num_pixels, num_bands):
        pixels = pixels.T
    if pixels.shape != (num_pixels, num_bands) or abundances.shape[1] != count:
        shapes = ", ".join(f"{key} {np.shape(content[key])}" for key in ("Y", "A", "M"))
        raise SceneError(
            f"{path}: expected Y (bands, pixels), A (materials, pixels), M (bands, materials); found {shapes}"
        )
    if not float(pixels.max()) > 0:
        raise SceneError(f"{path}: Y holds no light; its largest value is {float(pixels.max()):g}")
    return (
        torch.from_numpy(pixels.copy()),
        torch.from_numpy(abundances.copy()),
        torch.from_numpy(endmembers.copy()),
    )


def _matrix(values: np.ndarray, key: str, path: Path) -> np.ndarray:
    """As float64 with two axes; of an image the rows and columns become one, columns first, as MATLAB does."""
    if values.dtype.kind not in "iufb" or values.ndim not in (2, 3):
        raise SceneError(
            f"{path}: {key} must be a matrix of real numbers; found {values.dtype} of shape {values.shape}"
        )
    if not np.isfinite(values).all():
        raise SceneError(f"{path}: {key} holds NaN or infinite values")
    if values.ndim == 3:
        values = values.reshape(-1, values.shape[2], order="F")
    return values.astype(np.float64)
