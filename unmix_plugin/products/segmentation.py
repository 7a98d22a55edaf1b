"""Segmentations: ids, scores and a figure with a legend of every view; and what the ids mean."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from unmix_plugin.figures.pictures import NEUTRAL, Picture, TitledPicture, draw_panels
from unmix_plugin.figures.plotting import Colour
from unmix_plugin.formats.files import array_bytes, csv_bytes, indexed_png_bytes, write_file
from unmix_plugin.products.abundances import colour_panel
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Segmentation
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.evaluation import PredictedView
from unmix_plugin.trained.run_materials import endmember_colours


def export(job: Job, asked: Segmentation) -> list[Path]:
    """Write scores, figure and ids of views, and the legend of the ids."""
    path, legend = job.folder / "legend.csv", _legend_bytes(job.materials)
    if not (path.is_file() and path.read_bytes() == legend):  # other views of the same run have the same
        job.claim([path])
    written = job.write_views(asked.views, _view_paths, _write_view)
    if job.processes.is_first:
        write_file(path, legend)
    return [*written, path]


def _view_paths(folder: Path, view: str) -> list[Path]:
    """Scores, figure, ids."""
    return [folder / f"{view}.npy", folder / f"{view}.png", folder / "labels" / f"{view}.png"]


def _write_view(folder: Path, view: str, rendered: PredictedView, materials: Materials) -> None:
    """The id of a pixel is the index of its largest score."""
    scores_path, figure_path, labels_path = _view_paths(folder, view)
    write_file(scores_path, array_bytes(_scores_of(rendered, materials).numpy().astype(np.float32)))
    write_file(figure_path, draw_segmentation(view, rendered, materials))
    palette = _id_palette(dict(enumerate(endmember_colours(materials))))
    write_file(labels_path, indexed_png_bytes(rendered.segmentation.numpy(), palette, NOTHING_ID))


def _legend_bytes(materials: Materials) -> bytes:
    """What the ids mean as CSV: `id,name,red,green,blue`, sRGB of the palette as 0 to 255."""
    palette = np.round(255 * _id_palette(dict(enumerate(endmember_colours(materials))))).astype(int)
    named = [*enumerate(materials.names), (NOTHING_ID, "nothing")]
    rows = [[index, name, *palette[index]] for index, name in named]
    return csv_bytes([["id", "name", "red", "green", "blue"], *rows])


def _scores_of(view: PredictedView, materials: Materials) -> Float[Tensor, "H W K"]:
    """What the ids are chosen by: abundances, or cosines to the endmembers (0 where nothing is)."""
    if materials.segmentation == "abundances":
        return view.abundances
    return view.material_scores * (view.segmentation != NOTHING_ID)[..., None]


def draw_segmentation(name: str, view: PredictedView, materials: Materials) -> bytes:
    """A figure of a view in colour and of its materials, with a legend of those that occur."""
    colours = endmember_colours(materials)
    ids = view.segmentation.numpy()
    painted = TitledPicture(paint_ids(ids, dict(enumerate(colours))), "materials")
    present = [index for index in range(len(colours)) if (ids == index).any()]
    legend = [(materials.names[index], colours[index]) for index in present]
    return draw_panels(
        [[colour_panel(view, materials.bands), painted]], f"{name}: segmentation", legend=legend
    )


def paint_ids(ids: UInt8[np.ndarray, "H W"], colours: Mapping[int, Colour]) -> Picture:
    """Ids as their colours; those without one, and 255, as neutral grey."""
    return _id_palette(colours)[ids]


def _id_palette(colours: Mapping[int, Colour]) -> Float64[np.ndarray, "256 3"]:
    """sRGB of each id, neutral grey for those without a colour."""
    palette = np.full((256, 3), NEUTRAL)
    for index, colour in colours.items():
        palette[index] = colour
    return palette
