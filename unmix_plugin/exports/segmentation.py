"""Segmentations: ids, scores and a picture with a legend, a view."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.exports.figures import NEUTRAL, Colour, Panel, Picture, draw_panels
from unmix_plugin.exports.files import array_bytes, label_image_bytes, write_file
from unmix_plugin.exports.run_materials import endmember_colours
from unmix_plugin.exports.view_rendering import RenderedView, picture
from unmix_plugin.spectral.colour import colour_mode
from unmix_plugin.spectral.composition import Materials
from unmix_plugin.spectral.segmentation import NOTHING_ID


def segmentation_paths(folder: Path, name: str) -> list[Path]:
    """Files that `write_segmentation` makes for a view."""
    return [folder / f"{name}.npy", folder / f"{name}.png", folder / "labels" / f"{name}.png"]


def write_segmentation(folder: Path, name: str, view: RenderedView, materials: Materials) -> list[Path]:
    """Write a view's scores (H, W, K) float32, a figure, and its ids as 8-bit PNG, 255 where nothing is.

    The id of a pixel is the index of its largest score.

    Raises:
        RunError: the disk is full or refuses.
    """
    scores_path, figure_path, labels_path = segmentation_paths(folder, name)
    write_file(scores_path, array_bytes(scores_of(view, materials).numpy().astype(np.float32)))
    write_file(figure_path, draw_segmentation(name, view, materials))
    write_file(labels_path, label_image_bytes(view.segmentation.numpy()))
    return [scores_path, figure_path, labels_path]


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
    legend = [(f"endmember {index}", colours[index]) for index in present]
    return draw_panels([panels], f"{name}: segmentation", legend=legend)


def paint_ids(ids: UInt8[np.ndarray, "H W"], colours: Mapping[int, Colour]) -> Picture:
    """Ids as their colours; those without one, and 255, as neutral grey."""
    palette = np.full((256, 3), NEUTRAL)
    for index, colour in colours.items():
        palette[index] = colour
    return palette[ids]
