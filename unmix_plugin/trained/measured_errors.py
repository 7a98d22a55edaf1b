"""What training views measured beside what a scene renders, pixel by pixel: where expected errors come from, and the
file of a run that keeps them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open

from unmix_plugin.engine.runs.atomic_files import whole_file, write_errors_as
from unmix_plugin.engine.runs.replacing import remove
from unmix_plugin.errors import RunError
from unmix_plugin.losses.abundance_guide import mixing_penalty
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.unmixing.abundances import nnls, sparse_abundances
from unmix_plugin.spectral.unmixing.endmembers import has_spectral_shape
from unmix_plugin.trained.place_errors import PixelErrors, PlaceErrors
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.trained.training_views import ThinnedView

FILE_NAME = "errors.safetensors"
"""In the folder of a run."""
_PIXELS = 40_000
"""Of all training views, background included, that are compared."""
_LEAST_PIXELS = 500
"""With fewer nothing is said."""
_STEPS = "steps"
_MOST_BYTES = 1 << 30


@torch.no_grad()
def measure_errors(trained: TrainedScene, views: Sequence[ThinnedView]) -> PlaceErrors | None:
    """How far a scene as it was trained is from what its training views with all bands measured; None where these are
    fewer than three or show too little. Abundances are compared with those of the measured spectra as mixtures of few
    endmembers, and as mixtures of any number: where spectra do not tell mixtures apart, the two differ."""
    step = max(1, round(sum(view.opacity.size for view in views) / _PIXELS))
    parts = []
    for number, view in enumerate(views):
        shown = (view.opacity[..., None], view.points, view.rendered, view.abundances, view.measured)
        columns = [torch.from_numpy(one).flatten(0, 1).float() for one in shown]
        kept = view.is_whole & (view.opacity > OCCUPIED_ACCUMULATION)
        counts = torch.from_numpy(kept).flatten() & has_spectral_shape(columns[-1])
        rows = counts.nonzero()[number % step :: step, 0]
        if len(rows):
            parts.append([torch.full((len(rows),), number), *(column[rows] for column in columns)])
    if len(parts) < 3 or sum(len(part[0]) for part in parts) < _LEAST_PIXELS:
        return None
    of_view, opacity, places, rendered, abundances, measured = map(torch.cat, zip(*parts, strict=True))
    abundances, endmembers = abundances / opacity, trained.materials.endmembers.cpu()
    amounts = nnls(measured.double(), endmembers.double())
    of_any = (amounts / amounts.sum(dim=1, keepdim=True).clamp(min=1e-12)).float()
    both = (sparse_abundances(measured, endmembers, mixing_penalty(measured, endmembers)), of_any)
    errors = PixelErrors(
        places,
        of_view,
        rendered / opacity - measured,
        tuple(abundances - one for one in both),
        tuple(torch.maximum(abundances, one) for one in both),
    )
    return PlaceErrors.fit(errors, trained.scene_box.aabb[0].cpu(), trained.pixel_size)


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
