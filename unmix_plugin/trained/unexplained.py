"""What no mixture of a run's materials explains, at each place of the surface, as its training views measured it.

Space is divided into cells a pixel wide. In each, the mean of what the views measured there is compared with the
nearest mixture of the endmembers in any brightness (non-negative least squares); highlights hardly count, since each is
in few views. What is left of the mean, less what the spread of the pixels explains, over its length is the unexplained
part u:

    u^2 = max(0, |m - E a|^2 - s^2) / |m|^2,    s^2 = sum_i |x_i - (x_i . m) m / |m|^2|^2 / (n (n - 1))

of n pixels x_i with mean m. It is the sine of the angle between what was measured and what the materials can be. A
patch is a group of touching cells whose u stands out from that of the whole surface and from noise: a retouch, a stain,
a material that is missing among the endmembers. A mixture that the field got wrong is none: `training_views` and the
metrics of `unmix-eval` have those.

Notation: `C` cells, `P` pixels, `B` bands, `K` materials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from unmix_plugin.engine.runs.run_json import read_run_json, write_run_json
from unmix_plugin.engine.sampling import robust_deviation
from unmix_plugin.errors import RunError
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.unmixing.abundances import nnls
from unmix_plugin.trained.place_errors import NEIGHBOURS, CellGrid, find_keys
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.trained.training_views import ThinnedView
from unmix_plugin.trained.unexplained_map import MOST_CELLS, UnexplainedMap, read_unexplained_map

FILE_NAME, SPECTRA_NAME = "unexplained.json", "unexplained.csv"
"""In the folder of a run, beside the map."""
_WHOLE_OPACITY = 0.9
"""Opacity from which a ray ends on one place."""
_FEWEST_RAYS = 3
"""For each pixel of the views: seven false patches were named after 0.6, one after 2, none after 9."""
_FEWEST_VIEWS = 3
"""That have to see a cell."""
_DARK = 0.1
"""Brightness of a cell over the median of all, below which noise and stray light are most of it."""
_LEAST_PART, _DEVIATIONS = 0.04, 6.0
"""u of a patch: at least so much, and so many robust standard deviations above the median of the surface."""
_LEAST_SIGNIFICANCE = 4.0
"""Of what is left of a cell's mean over its standard error."""
_FEWEST_CELLS, _LEAST_SURFACE = 4, 0.002
"""Of a patch, alone and over all cells."""
_POORLY = 0.08
"""Median of u from which the materials explain the scene poorly everywhere."""


@dataclass(frozen=True)
class UnexplainedPatch:
    """A part of the surface that none of the materials, nor any mixture of them, explains."""

    position: Float64[np.ndarray, "3"]
    """Its middle, world of the scene's transforms.json."""
    surface: float
    """Part of the surface that was measured, (0, 1]."""
    part: float
    """u, mean over its cells."""
    num_views: int
    """That see it."""
    spectrum: Float64[np.ndarray, " B"]
    """Measured radiance, mean over its pixels."""

    def in_words(self) -> str:
        """What is wrong where."""
        place = ", ".join(f"{value:.3g}" for value in self.position)
        return (
            f"at ({place}), {self.surface:.1%} of the surface: {self.num_views} views measured a spectrum that no "
            f"mixture of the materials gives, off by {self.part:.0%}"
        )


@dataclass(frozen=True)
class Unexplained:
    """What the materials of a run do not explain."""

    map: UnexplainedMap
    patches: tuple[UnexplainedPatch, ...]
    """The largest first."""
    median: float
    """u of half of the surface is at most this."""
    num_materials: int
    """Of the run."""

    def in_words(self, run: Path) -> list[str]:
        """Warnings, with what to do; none if there is nothing to warn of."""
        if self.median > _POORLY:
            poorly = (
                f"half of the surface is off by more than {self.median:.0%} from any mixture of the materials"
            )
            return [f"{poorly}; train with more than --endmembers {self.num_materials}"]
        count = self.num_materials + len(self.patches)
        remedy = (
            f"to add what was measured there as materials, train with --endmembers {count} --endmember-init file "
            f"--endmember-file {run / SPECTRA_NAME}"
        )
        sentences = [patch.in_words() for patch in self.patches]
        return [*sentences, remedy] if sentences else []


def find_unexplained(
    trained: TrainedScene, views: Sequence[ThinnedView], num_rays: int | None = None
) -> Unexplained | None:
    """Judge the surface by what the views measured; None where too little of it is seen by enough views, or was trained
    by so few rays (of all steps) that endmembers have not settled: what they leave then says nothing of the scene."""
    if num_rays is not None and num_rays < _FEWEST_RAYS * sum(view.counts.size for view in views):
        return None
    spectra, points, sizes, numbers = [], [], [], []
    for number, view in enumerate(views):
        ends = view.counts & ~view.blown_out & (view.opacity > _WHOLE_OPACITY)
        ends &= np.isfinite(view.points).all(axis=-1)
        ends &= (
            trained.scene_box.contains(torch.from_numpy(view.points).float().to(trained.device)).cpu().numpy()
        )
        spectra.append(view.measured[ends])
        points.append(view.points[ends])
        sizes.append(view.pixel[ends])
        numbers.append(np.full(int(ends.sum()), number))
    if not sum(map(len, points)):
        return None
    measured, places, seen_by = np.concatenate(spectra), np.concatenate(points), np.concatenate(numbers)
    origin = places.min(axis=0)
    edge = max(float(np.median(np.concatenate(sizes))), float(np.ptp(places, axis=0).max()) / MOST_CELLS)
    of_pixels = CellGrid(torch.from_numpy(origin), edge).indices(torch.from_numpy(places)).numpy()
    cells, cell_of, counts = np.unique(of_pixels, axis=0, return_inverse=True, return_counts=True)
    cell_of = cell_of.reshape(-1)
    pairs = np.unique(np.stack([cell_of, seen_by], axis=1), axis=0)
    num_views = np.bincount(pairs[:, 0], minlength=len(cells))

    mean = np.zeros((len(cells), measured.shape[1]))
    np.add.at(mean, cell_of, measured)
    mean /= counts[:, None]
    length = np.linalg.norm(mean, axis=1)
    usable = (num_views >= _FEWEST_VIEWS) & (length > _DARK * np.median(length))
    if usable.sum() < _FEWEST_CELLS:
        return None
    direction = mean / np.maximum(length, 1e-12)[:, None]
    along = (measured * direction[cell_of]).sum(axis=1, keepdims=True)
    across = ((measured - along * direction[cell_of]) ** 2).sum(axis=1)
    variance = np.bincount(cell_of, across, len(cells)) / np.maximum(counts * (counts - 1), 1)
    # The mixtures of the endmembers, in any brightness, that come nearest.
    known_spectra = trained.materials.endmembers.detach().double().cpu()
    left = mean[usable] - (nnls(torch.from_numpy(mean[usable]), known_spectra) @ known_spectra).numpy()
    squares = (left**2).sum(axis=1)
    part = np.sqrt(np.maximum(squares - variance[usable], 0)) / length[usable]

    median = float(np.median(part))
    deviation = float(robust_deviation(part))
    stands_out = part > max(_LEAST_PART, median + _DEVIATIONS * deviation)
    stands_out &= squares > _LEAST_SIGNIFICANCE**2 * variance[usable]
    known, rows = cells[usable], np.flatnonzero(usable)
    patches = []
    for group in _touching(known, stands_out):
        if len(group) < max(_FEWEST_CELLS, _LEAST_SURFACE * len(known)):
            continue
        pixels = np.isin(cell_of, rows[group])
        middle = np.median(places[pixels], axis=0)
        patches.append(
            UnexplainedPatch(
                position=trained.frame.to_world(middle[None])[0],
                surface=len(group) / len(known),
                part=float(part[group].mean()),
                num_views=len(np.unique(seen_by[pixels])),
                spectrum=measured[pixels].mean(axis=0),
            )
        )
    patches.sort(key=lambda patch: -patch.surface)
    return Unexplained(
        UnexplainedMap(origin, edge, known, part.astype(np.float32)),
        tuple(patches),
        median,
        len(trained.materials.names),
    )


def _touching(
    cells: Int64[np.ndarray, "C 3"], chosen: Bool[np.ndarray, " C"]
) -> list[Int64[np.ndarray, " N"]]:
    """Rows of the chosen cells, by groups that touch at faces, edges or corners."""
    picked = np.flatnonzero(chosen)
    if not len(picked):
        return []
    known, order = CellGrid.keys_of(torch.from_numpy(cells[picked])).sort()
    found = [find_keys(known, known + step) for step in NEIGHBOURS]
    first = torch.cat([is_there.nonzero()[:, 0] for _, is_there in found]).numpy()
    second = torch.cat([rows[is_there] for rows, is_there in found]).numpy()
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(len(picked), len(picked)))
    count, groups = connected_components(links, directed=False)
    return [picked[order.numpy()[groups == number]] for number in range(count)]


def write_unexplained(run: Path, found: Unexplained, materials: Materials) -> None:
    """Write what was found into the folder of a run and, where there are patches, the materials with their spectra
    after them, as reflectances where the light is known: what `--endmember-file` takes."""
    found.map.write(run)
    patches = [
        {**asdict(patch), "position": patch.position.tolist(), "spectrum": patch.spectrum.tolist()}
        for patch in found.patches
    ]
    write_run_json(
        run / FILE_NAME, {"median": found.median, "num_materials": found.num_materials, "patches": patches}
    )
    if not found.patches:
        return
    table, lit = materials.table(), materials.is_lit.cpu().numpy()
    spectra = np.concatenate([table.spectra, [patch.spectrum for patch in found.patches]])
    if materials.light is not None:
        spectra = np.where(lit, spectra / np.where(lit, materials.light.cpu().double().numpy(), 1.0), 0.0)
    names = [*table.names, *(f"unexplained {number + 1}" for number in range(len(found.patches)))]
    write_spectra_csv(run / SPECTRA_NAME, SpectraTable(table.bands, tuple(names), spectra.clip(min=0)))


def read_unexplained(run: Path) -> Unexplained | None:
    """What was found at the end of a run's training; None where nothing was written, a RunError where it is damaged."""
    path, cells = run / FILE_NAME, read_unexplained_map(run)
    if cells is None or not path.is_file():
        return None
    values = read_run_json(path)
    try:
        patches = [
            UnexplainedPatch(
                np.array(patch["position"], dtype=np.float64),
                float(patch["surface"]),
                float(patch["part"]),
                int(patch["num_views"]),
                np.array(patch["spectrum"], dtype=np.float64),
            )
            for patch in values["patches"]
        ]
        return Unexplained(cells, tuple(patches), float(values["median"]), int(values["num_materials"]))
    except (KeyError, TypeError, ValueError):
        raise RunError(f"{path} is damaged; delete it to go on without what it says") from None


def describe_unexplained(run: Path) -> list[str]:
    """Warnings of what the materials of a run do not explain; none where that is not known."""
    found = read_unexplained(run)
    return [] if found is None else found.in_words(run)
