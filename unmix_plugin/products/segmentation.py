"""Segmentations: ids, scores and a picture with a legend, a view; and what the ids mean."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8
from torch import Tensor

from unmix_plugin.figures.picture_grid import NEUTRAL, Colour, Panel, Picture, draw_panels
from unmix_plugin.formats.files import array_bytes, write_file
from unmix_plugin.formats.png import indexed_png_bytes
from unmix_plugin.spectral.colour.conversion import colour_mode
from unmix_plugin.spectral.composition import Materials
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.view_rendering import RenderedView, picture


def segmentation_paths(folder: Path, name: str) -> list[Path]:
    """Files that `write_segmentation` makes for a view."""
    return [folder / f"{name}.npy", folder / f"{name}.png", folder / "labels" / f"{name}.png"]


def write_segmentation(folder: Path, name: str, view: RenderedView, materials: Materials) -> list[Path]:
    """Write a view's scores (H, W, K) float32, a figure, and its ids as a PNG with their palette, 255 where nothing is.

    The id of a pixel is the index of its largest score.

    Raises:
        RunError: the disk is full or refuses.
    """
    scores_path, figure_path, labels_path = segmentation_paths(folder, name)
    write_file(scores_path, array_bytes(scores_of(view, materials).numpy().astype(np.float32)))
    write_file(figure_path, draw_segmentation(name, view, materials))
    write_file(labels_path, indexed_png_bytes(view.segmentation.numpy(), _palette(materials), NOTHING_ID))
    return [scores_path, figure_path, labels_path]


def legend_path(folder: Path) -> Path:
    """The file that `write_legend` makes."""
    return folder / "legend.csv"


def is_legend_there(folder: Path, materials: Materials) -> bool:
    """Whether `write_legend` would write what is there already."""
    path = legend_path(folder)
    return path.is_file() and path.read_bytes() == _legend_bytes(materials)


def write_legend(folder: Path, materials: Materials) -> Path:
    """Write what the ids mean: `id,name,red,green,blue`, sRGB of the palette as 0 to 255.

    Raises:
        RunError: the disk is full or refuses.
    """
    return write_file(legend_path(folder), _legend_bytes(materials))


def _legend_bytes(materials: Materials) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["id", "name", "red", "green", "blue"])
    palette = np.round(255 * _palette(materials)).astype(int)
    for index, name in [*enumerate(materials.names), (NOTHING_ID, "nothing")]:
        writer.writerow([index, name, *palette[index]])
    return text.getvalue().encode()


def scores_of(view: RenderedView, materials: Materials) -> Float[Tensor, "H W K"]:
    """What the ids are chosen by: abundances, or cosines to the endmembers (0 where nothing is)."""
    if materials.segmentation == "abundances":
        return view.abundances
    return view.material_scores * (view.segmentation != NOTHING_ID)[..., None]


def draw_segmentation(name: str, view: RenderedView, materials: Materials) -> bytes:
    """A figure of a view in colour and of its materials, with a legend of those that occur."""
    colours = endmember_colours(materials)
    ids = view.segmentation.numpy()
    kind = "colour" if colour_mode(materials.bands) == "true-colour" else "false colour"
    panels = [
        Panel(picture(view.spectra, view.accumulation, materials.bands), kind),
        Panel(paint_ids(ids, dict(enumerate(colours))), "materials"),
    ]
    present = [index for index in range(len(colours)) if (ids == index).any()]
    legend = [(materials.names[index], colours[index]) for index in present]
    return draw_panels([panels], f"{name}: segmentation", legend=legend)


def paint_ids(ids: UInt8[np.ndarray, "H W"], colours: Mapping[int, Colour]) -> Picture:
    """Ids as their colours; those without one, and 255, as neutral grey."""
    palette = np.full((256, 3), NEUTRAL)
    for index, colour in colours.items():
        palette[index] = colour
    return palette[ids]


def _palette(materials: Materials) -> Float64[np.ndarray, "256 3"]:
    """sRGB of each id, neutral grey for those that nothing has."""
    palette = np.full((256, 3), NEUTRAL)
    palette[: len(materials.names)] = endmember_colours(materials)
    return palette
