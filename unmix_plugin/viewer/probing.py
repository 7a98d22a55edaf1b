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
from unmix_plugin.engine.geometry.rays import RayBundle
from unmix_plugin.errors import ConfigError
from unmix_plugin.model import UnmixModel
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.composition import OCCUPIED_ACCUMULATION, spectral

_FOOTPRINT = 3
"""Rays along each edge of the pixel that is probed."""


@dataclass(frozen=True)
class Probe:
    """What one point is made of."""

    number: int
    """From 1."""
    point: tuple[float, float, float]
    """Model space."""
    bands: Bands
    predicted: Float64[np.ndarray, " B"]
    """Radiance, as rendered."""
    abundances: Float64[np.ndarray, " K"]
    """Shares, sum 1."""
    names: tuple[str, ...]
    endmembers: Float64[np.ndarray, "K B"]
    """Of the materials as they are shown."""
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


@torch.no_grad()
def probe(model: UnmixModel, camera: Cameras, column: float, row: float, number: int) -> Probe:
    """What is seen through a point of a picture, the mean over about a pixel.

    Args:
        model: With the materials as they are shown.
        camera: One camera.
        column, row: In pixels.
        number: Of the probe.
    Raises:
        ConfigError: nothing is there.
    """
    steps = (torch.arange(_FOOTPRINT) + 0.5) / _FOOTPRINT - 0.5
    offsets = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2)
    coords = torch.tensor([column, row]) + offsets
    bundle: RayBundle = camera.generate_rays(torch.zeros(len(coords), dtype=torch.int64), coords)
    coefficients = model.renderer(model.field, bundle.to(model.device)).coefficients
    opacity = float(coefficients.accumulation.mean())
    if opacity < OCCUPIED_ACCUMULATION:
        raise ConfigError("nothing is there to probe: less than half of the light ends on something")
    materials = model.materials
    shares = coefficients.abundances.mean(dim=0)
    distance = coefficients.distance / coefficients.accumulation.clamp(min=1e-6)
    solid = coefficients.accumulation >= OCCUPIED_ACCUMULATION
    points = bundle.origins.to(model.device) + distance[:, None] * bundle.directions.to(model.device)
    x, y, z = points[solid].mean(dim=0).tolist()
    return Probe(
        number,
        (x, y, z),
        materials.bands,
        spectral(coefficients, materials).mean(dim=0).double().cpu().numpy() / opacity,
        (shares / shares.sum().clamp(min=1e-6)).double().cpu().numpy(),
        materials.names,
        materials.endmembers.detach().double().cpu().numpy(),
    )


def spectra_csv(probes: Sequence[Probe]) -> bytes:
    """One row a band: wavelength, and for each probe what was predicted and, where known, measured."""
    header, columns = ["wavelength"], [probes[0].bands.centers_nm]
    for one in probes:
        header.append(f"probe_{one.number}_predicted")
        columns.append(one.predicted)
        if one.measured is not None:
            header.append(f"probe_{one.number}_measured")
            columns.append(one.measured)
    return _csv(header, [[f"{value:.9g}" for value in row] for row in np.stack(columns, axis=1)])


def abundances_csv(probes: Sequence[Probe]) -> bytes:
    """One row a probe: number, position in model space, material, the training view measured in, abundances."""
    header = ["probe", "x", "y", "z", "material", "measured_in", *probes[0].names]
    rows = [
        [
            str(one.number),
            *(f"{value:.9g}" for value in one.point),
            one.names[one.material],
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
