"""The map of what a run's materials do not explain, by cells of model space; `unexplained` finds it.

Notation: `C` cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from scipy import ndimage
from torch import Tensor

from unmix_plugin.engine.runs.atomic_files import whole_file
from unmix_plugin.errors import RunError

FILE_NAME = "unexplained.npz"
"""In the folder of a run."""
MOST_CELLS = 512
"""Along an axis; a larger scene has larger cells."""


@dataclass(frozen=True)
class UnexplainedMap:
    """The unexplained part by cells of model space."""

    origin: Float64[np.ndarray, "3"]
    """Corner of the cell (0, 0, 0), model space."""
    edge: float
    """Of a cell, model units."""
    cells: Int64[np.ndarray, "C 3"]
    values: Float32[np.ndarray, " C"]
    """u, [0, 1]."""

    @cached_property
    def _smooth(self) -> Float32[np.ndarray, "X Y Z"]:
        """The mean of each cell and the 26 around it, as far as they are known; with a margin of one cell."""
        known = np.full(tuple(self.cells.max(axis=0) + 3), np.nan, dtype=np.float32)
        known[tuple((self.cells + 1).T)] = self.values
        there = np.isfinite(known).astype(np.float64)
        total, weight = (
            ndimage.uniform_filter(values, 3, mode="constant")
            for values in (np.nan_to_num(known) * there, there)
        )
        return np.where(weight > 1e-6, total / np.maximum(weight, 1e-6), np.nan).astype(np.float32)

    def at(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """u at points of model space: the mean of their cell and the 26 around it that are known, NaN without any."""
        smooth = self._smooth
        place = points.detach().cpu().double().numpy()
        index = np.floor((place - self.origin) / self.edge).astype(np.int64) + 1
        inside = ((index >= 0) & (index < smooth.shape)).all(axis=-1)
        index = np.where(np.expand_dims(inside, -1), index, 0)
        found = np.where(inside, smooth[tuple(np.moveaxis(index, -1, 0))], np.nan)
        return torch.from_numpy(found.astype(np.float32)).to(points.device)

    def write(self, run: Path) -> None:
        """Write it into the folder of a run."""
        with whole_file(run / FILE_NAME) as path, path.open("wb") as file:
            np.savez_compressed(
                file, origin=self.origin, edge=self.edge, cells=self.cells, values=self.values
            )


def read_unexplained_map(run: Path) -> UnexplainedMap | None:
    """The map of a run; None where none was written, a RunError where it is damaged."""
    path = run / FILE_NAME
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as stored:
            cells, values = stored["cells"].astype(np.int64), stored["values"].astype(np.float32)
            origin, edge = stored["origin"].astype(np.float64), float(stored["edge"])
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise RunError(
            f"{path} is damaged: {error}; delete it to go on without the map of what is unexplained"
        ) from None
    is_sound = (
        cells.ndim == 2 and cells.shape == (len(values), 3) and len(values) > 0 and origin.shape == (3,)
    )
    if not (is_sound and edge > 0 and cells.min() >= 0 and cells.max() <= 2 * MOST_CELLS):
        raise RunError(f"{path} is damaged; delete it to go on without the map of what is unexplained")
    return UnexplainedMap(origin, edge, cells, values)
