"""What training views measured beside what a scene renders, pixel by pixel: where expected errors come from, and the
file of a run that keeps them.

Notation: `B` bands, `K` endmembers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from torch import Tensor

from unmix_plugin.engine.runs.atomic_files import whole_file, write_errors_as
from unmix_plugin.engine.runs.replacing import remove
from unmix_plugin.errors import RunError
from unmix_plugin.losses.abundance_guide import mixing_penalty
from unmix_plugin.rendering.front_to_back import composite
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA
from unmix_plugin.spectral.unmixing.abundances import nnls, sparse_abundances
from unmix_plugin.spectral.unmixing.endmembers import has_spectral_shape
from unmix_plugin.trained.place_errors import PixelErrors, PlaceErrors
from unmix_plugin.trained.places import MeasuredScene
from unmix_plugin.trained.trained_scene import TrainedScene

FILE_NAME = "errors.safetensors"
"""In the folder of a run."""
_PIXELS = 40_000
"""Of all training views, background included, that are compared."""
_LEAST_PIXELS = 500
"""With fewer nothing is said."""
_STEPS = "steps"
_MOST_BYTES = 1 << 30


@torch.no_grad()
def measure_errors(trained: TrainedScene, measured: MeasuredScene) -> PlaceErrors | None:
    """How far a scene as it was trained is from what its training views with all bands measured; None where these are
    fewer than three or show too little. Reads their cubes."""
    scene, views, parts = measured.scene, [], []
    indices = measured.usable_views
    for number, index in enumerate(indices):
        camera = measured.camera(index, trained)
        stride = max(1, round((camera.width * camera.height * len(indices) / _PIXELS) ** 0.5))
        rows, columns = (slice((turn * number) % stride, None, stride) for turn in (1, 3))
        values = measured.comparable(index, scene.cube(index, (rows, columns)), trained)
        counts, alpha = scene.valid_mask(index, (rows, columns)), scene.alpha(index)
        if alpha is not None:
            counts = counts & (alpha[rows, columns] > OPAQUE_ALPHA)
        grid = np.stack(
            np.meshgrid(np.arange(camera.width)[columns], np.arange(camera.height)[rows]), axis=-1
        )
        coords = torch.from_numpy(grid[counts] + 0.5).float()
        if len(coords) == 0:
            continue
        rays = camera.generate_rays(torch.zeros(len(coords), dtype=torch.int64), coords)
        seen = composite(trained.renderer, trained.field, rays.to(trained.device))
        spectra, kept = torch.from_numpy(values[counts]).to(trained.device).float(), seen.is_occupied
        kept = kept & has_spectral_shape(spectra)
        places = rays.origins.to(trained.device) + seen.ray_distance[:, None] * rays.directions.to(
            trained.device
        )
        opaque = seen.accumulation.clamp(min=1e-6)[:, None]
        abundances, rendered = seen.abundances / opaque, trained.materials.spectra(seen) / opaque
        of_view = torch.full((len(coords),), number, device=trained.device)
        found = (places, of_view, rendered, abundances, spectra)
        parts.append([one[kept].cpu() for one in found])
        views += [number] if bool(kept.any()) else []
    if len(views) < 3 or sum(len(part[0]) for part in parts) < _LEAST_PIXELS:
        return None
    places, of_view, rendered, abundances, spectra = map(torch.cat, zip(*parts, strict=True))
    return PlaceErrors.fit(
        _compared(trained, places, of_view, rendered, abundances, spectra),
        trained.scene_box.aabb[0].cpu(),
        trained.pixel_size,
    )


def _compared(
    trained: TrainedScene,
    places: Float[Tensor, "N 3"],
    views: Tensor,
    rendered: Float[Tensor, "N B"],
    abundances: Float[Tensor, "N K"],
    measured: Float[Tensor, "N B"],
) -> PixelErrors:
    """Errors of pixels: abundances against those of the measured spectra as mixtures of few endmembers, and as mixtures
    of any number. Where spectra do not tell mixtures apart, the two differ."""
    endmembers = trained.materials.endmembers.cpu()
    amounts = nnls(measured.double(), endmembers.double())
    of_any = (amounts / amounts.sum(dim=1, keepdim=True).clamp(min=1e-12)).float()
    of_few = sparse_abundances(measured, endmembers, mixing_penalty(measured, endmembers))
    both = (of_few, of_any)
    return PixelErrors(
        places,
        views,
        rendered - measured,
        tuple(abundances - one for one in both),
        tuple(torch.maximum(abundances, one) for one in both),
    )


def write_errors(run: Path, errors: PlaceErrors | None, steps: int) -> None:
    """Keep errors that were measured after so many training steps in the folder of a run, or none."""
    path = run / FILE_NAME
    if errors is None:
        remove(path)
        return
    tensors = {name: values.detach().cpu().contiguous() for name, values in errors.tensors().items()}
    with whole_file(path) as temporary, write_errors_as(path):
        safetensors.torch.save_file(tensors, temporary, {_STEPS: str(steps)})


def read_errors(run: Path, steps: int, num_bands: int, num_endmembers: int) -> PlaceErrors | str:
    """The errors of a run, or why there are none, for people.

    Raises:
        RunError: the file is damaged.
    """
    path = run / FILE_NAME
    if not path.is_file():
        return (
            "the run has no errors.safetensors: its training has not ended, had fewer than three views with all bands, "
            "or was made by an earlier version"
        )
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"it has more than {_MOST_BYTES:,} bytes")
        with safe_open(path, "pt") as file:
            measured_at = int((file.metadata() or {}).get(_STEPS, -1))
            errors = PlaceErrors.of_tensors({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        shapes = (errors.directions.shape[1], errors.large.sums.shape[1], errors.small.sums.shape[1])
        if shapes != (num_bands, num_endmembers + 1, num_endmembers + 1):
            raise ValueError("it is of another number of bands or endmembers")
    except (OSError, SafetensorError, KeyError, IndexError, ValueError) as error:
        raise RunError(f"{path} is damaged ({error}); remove it, and there are no intervals") from error
    if measured_at != steps:
        return f"errors were measured after {measured_at} steps, and the run has {steps}: train it to its end"
    return errors
