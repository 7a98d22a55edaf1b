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
from torch import Tensor

from unmix_plugin.engine.runs.atomic_files import whole_file
from unmix_plugin.errors import RunError
from unmix_plugin.trained.place_errors import NEIGHBOURS, CellGrid, find_keys

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
    def _by_key(self) -> tuple[Int64[Tensor, " C"], Float32[Tensor, " C"]]:
        """Keys of the cells in their order, and their values: sorted once for all views."""
        known, order = CellGrid.keys_of(torch.from_numpy(self.cells)).sort()
        return known, torch.from_numpy(self.values)[order]

    def at(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points"]:
        """u at points of model space: the mean of their cell and the 26 around it that are known, NaN without any."""
        known, values = self._by_key
        keys = CellGrid(torch.from_numpy(self.origin), self.edge).keys(points.detach().cpu())
        total, count = torch.zeros(keys.shape), torch.zeros(keys.shape)
        for step in NEIGHBOURS:
            rows, is_there = find_keys(known, keys + step)
            total += values[rows].where(is_there, 0)
            count += is_there
        return (total / count).to(points.device)  # 0 / 0 is NaN

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
