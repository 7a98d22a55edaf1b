"""What training views measured beside what a scene renders, pixel by pixel: where expected errors come from, and the
file of a run that keeps them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import safetensors.torch
import torch
from jaxtyping import Float, Int64
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.nn.functional import normalize

from unmix_plugin.engine.runs.atomic_files import whole_file, write_errors_as
from unmix_plugin.engine.runs.replacing import remove
from unmix_plugin.errors import RunError, SpectrumError
from unmix_plugin.losses.abundance_guide import mixing_penalty
from unmix_plugin.spectral.evidence import has_spectral_shape
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION
from unmix_plugin.spectral.metrics import match_endmembers
from unmix_plugin.spectral.unmixing.abundances import nnls, sparse_abundances
from unmix_plugin.spectral.unmixing.endmembers import usable_pixels
from unmix_plugin.spectral.unmixing.pooled_search import pooled_search
from unmix_plugin.trained.place_errors import ComparedPixels, PlaceErrors
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.trained.training_views import ThinnedView

FILE_NAME = "errors.safetensors"
"""In the folder of a run."""
_PIXELS = 40_000
"""Of all training views, background included, that are compared."""
_LEAST_PIXELS = 500
"""With fewer nothing is said."""
_VIEW_GROUPS = 8
"""Of views, whose endmembers are compared."""
_STEPS, _FORMAT, _FORMAT_NOW = "steps", "format_version", "2"
"""What the metadata of the file hold: after how many steps errors were measured, and which layout it has."""
_MOST_BYTES = 1 << 30


@torch.no_grad()
def measure_errors(
    trained: TrainedScene, views: Sequence[ThinnedView], *, are_given: bool = False
) -> PlaceErrors | None:
    """How far a scene as it was trained is from what its training views with all bands measured; None where these are
    fewer than three or show too little.

    Abundances are compared with those of the measured spectra as mixtures of few endmembers, and as mixtures of any
    number: where spectra do not tell mixtures apart, the two differ. Unless the endmembers are given, both are moved by
    what becomes of a spectrum with other sets of endmembers that a search finds in what was measured."""
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
    endmembers = trained.materials.endmembers.cpu()
    amounts = nnls(measured.double(), endmembers.double())
    of_any = _fractions(amounts)
    of_few = sparse_abundances(measured, endmembers, mixing_penalty(measured, endmembers))
    possible, deviations = torch.stack([of_few, of_any]), _misfits(measured, amounts, endmembers, of_view)
    if not are_given and len(endmembers) > 1:
        sets = _other_sets(measured, endmembers)
        moved = torch.stack([_fractions(nnls(measured.double(), one.double())) for one in sets]) - of_any
        possible = (possible[:, None] + moved).clamp(0, 1).flatten(0, 1)
        deviations = (deviations.square() + (sets - endmembers).square().mean(dim=0)).sqrt()
    pixels = ComparedPixels(places, of_view, rendered / opacity, measured, abundances / opacity, possible)
    return PlaceErrors.fit(
        pixels, endmembers, deviations, trained.scene_box.aabb[0].cpu(), trained.pixel_size
    )


def _fractions(amounts: Float[Tensor, "N K"]) -> Float[Tensor, "N K"]:
    return (amounts / amounts.sum(dim=1, keepdim=True).clamp(min=1e-12)).float()


def _other_sets(measured: Float[Tensor, "N B"], endmembers: Float[Tensor, "K B"]) -> Float[Tensor, "S K B"]:
    """Sets that explain the spectra about as well, in the order of the endmembers and as bright; none but themselves
    where the spectra are too few to search in."""
    generator = torch.Generator().manual_seed(0)
    try:
        usable = usable_pixels(measured, len(endmembers), generator)
        found = pooled_search(usable, len(endmembers), generator, repeats=1).others
    except SpectrumError:
        return endmembers[None]
    orders = [match_endmembers(one, endmembers).pred_ids for one in found]
    matched = torch.stack([one[list(order)] for one, order in zip(found, orders, strict=True)])
    return normalize(matched, dim=-1) * endmembers.norm(dim=1, keepdim=True)


def _misfits(
    measured: Float[Tensor, "N B"],
    amounts: Float[Tensor, "N K"],
    endmembers: Float[Tensor, "K B"],
    of_view: Int64[Tensor, "N"],
) -> Float[Tensor, "K B"]:
    """How far endmembers are from those that fit all spectra best in the same amounts, and these from those of some of
    the views, as a root of the mean square."""
    groups = of_view % _VIEW_GROUPS
    rows = [torch.ones_like(groups, dtype=torch.bool), *(groups == one for one in groups.unique())]
    # A material that is hardly there stays as it is.
    ridge = (
        1e-3 * amounts.square().sum() / amounts.shape[1] * torch.eye(amounts.shape[1], dtype=amounts.dtype)
    )
    rest = measured.double() - amounts @ endmembers.double()
    changes = torch.stack(
        [
            torch.linalg.solve(
                amounts[own].T @ amounts[own] + own.double().mean() * ridge, amounts[own].T @ rest[own]
            )
            for own in rows
        ]
    )
    return (changes[0].square() + changes[1:].var(dim=0, correction=0)).sqrt().float()


def write_errors(run: Path, errors: PlaceErrors | None, steps: int) -> None:
    """Keep errors that were measured after so many training steps in the folder of a run, or none."""
    path = run / FILE_NAME
    if errors is None:
        remove(path)
        return
    tensors = {name: values.detach().cpu().contiguous() for name, values in errors.tensors().items()}
    with whole_file(path) as temporary, write_errors_as(path):
        safetensors.torch.save_file(tensors, temporary, {_STEPS: str(steps), _FORMAT: _FORMAT_NOW})


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
            metadata = file.metadata() or {}
            measured_at = int(metadata.get(_STEPS, -1))
            if metadata.get(_FORMAT) != _FORMAT_NOW:
                return "errors.safetensors is of an earlier version: train the run on, with a larger limit"
            errors = PlaceErrors.of_tensors({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
        shapes = (errors.directions.shape[1], errors.large.sums.shape[1], errors.small.sums.shape[1])
        if shapes != (num_bands, num_endmembers + 3, num_endmembers + 3):
            raise ValueError("it is of another number of bands or endmembers")
    except (OSError, SafetensorError, KeyError, IndexError, ValueError) as error:
        raise RunError(f"{path} is damaged ({error}); remove it, and there are no intervals") from error
    if measured_at != steps:
        return f"errors were measured after {measured_at} steps, and the run has {steps}: train it to its end"
    return errors
