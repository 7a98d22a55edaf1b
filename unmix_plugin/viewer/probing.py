"""What a point is made of: a ray through a click, its spectrum, its abundances, what training views measured there.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Materials
from unmix_plugin.trained.trained_scene import TrainedScene


@dataclass(frozen=True)
class ProbedPoint:
    """What one point is made of."""

    number: int
    """From 1."""
    point: tuple[float, float, float]
    """Model space."""
    materials: Materials
    """As they are shown."""
    predicted: Float64[np.ndarray, " B"]
    """Radiance, as rendered."""
    abundances: Float64[np.ndarray, " K"]
    """Shares, sum 1."""
    contributions: Float64[np.ndarray, "K B"]
    """Radiance that each endmember adds, as bright as it is there."""
    measured: Float64[np.ndarray, " B"] | None = None
    """Radiance in a training view that sees the point."""
    measured_in: str = ""
    """Name of that view."""

    @property
    def position(self) -> Float[Tensor, "3"]:
        """The point as a tensor."""
        return torch.tensor(self.point)

    @property
    def material(self) -> int:
        """The endmember of the largest share."""
        return int(self.abundances.argmax())

    @property
    def name(self) -> str:
        """Its name."""
        return self.materials.names[self.material]


def probe_through(
    scene: TrainedScene, camera: Cameras, column: float, row: float, number: int
) -> ProbedPoint:
    """What is seen through a point of a picture.

    Args:
        scene: With the materials as they are shown.
        camera: One camera.
        column, row: In pixels.
        number: Of the probe.
    Raises:
        ConfigError: nothing is there.
    """
    last_column, last_row = camera.width - 1, camera.height - 1
    found = scene.probe(camera, min(max(int(column), 0), last_column), min(max(int(row), 0), last_row))
    if found.opacity < OCCUPIED_ACCUMULATION or found.position is None:
        raise ConfigError("nothing is there to probe: less than half of the light ends on something")
    x, y, z = found.position.tolist()
    endmembers = scene.materials.endmembers.double().cpu().numpy()
    return ProbedPoint(
        number,
        (x, y, z),
        scene.materials,
        found.values["predicted"],
        found.values["abundances"],
        found.values["scaled_abundances"][:, None] * endmembers,
    )


def spectra_csv(probes: Sequence[ProbedPoint]) -> bytes:
    """One row a band: wavelength, and for each probe what was predicted and, where known, measured."""
    header, columns = ["wavelength"], [probes[0].materials.bands.centers_nm]
    for one in probes:
        header.append(f"probe_{one.number}_predicted")
        columns.append(one.predicted)
        if one.measured is not None:
            header.append(f"probe_{one.number}_measured")
            columns.append(one.measured)
    return _csv(header, [[f"{value:.9g}" for value in row] for row in np.stack(columns, axis=1)])


def abundances_csv(probes: Sequence[ProbedPoint]) -> bytes:
    """One row a probe: number, position in model space, material, the training view measured in, abundances."""
    header = ["probe", "x", "y", "z", "material", "measured_in", *probes[0].materials.names]
    rows = [
        [
            str(one.number),
            *(f"{value:.9g}" for value in one.point),
            one.name,
            one.measured_in,
            *(f"{value:.6g}" for value in one.abundances),
        ]
        for one in probes
    ]
    return _csv(header, rows)


def _csv(header: Sequence[str], rows: Sequence[Sequence[str]]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([header, *rows])
    return text.getvalue().encode()
