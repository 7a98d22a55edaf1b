"""Abundance maps: an array and a figure a view."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.exports.figures import ColourScale, Panel, draw_panels, in_rows, over_neutral, paint
from unmix_plugin.exports.files import array_bytes, write_file
from unmix_plugin.exports.run_materials import endmember_colours
from unmix_plugin.exports.view_rendering import RenderedView, as_numpy, picture
from unmix_plugin.spectral.colour import colour_mode
from unmix_plugin.spectral.composition import Materials

SHARE_SCALE = ColourScale("viridis", 0.0, 1.0, "abundance")
"""Colours of abundances, the same in every figure."""


def abundance_paths(folder: Path, name: str) -> list[Path]:
    """Files that `write_abundances` makes for a view."""
    return [folder / f"{name}.npy", folder / f"{name}.png"]


def write_abundances(folder: Path, name: str, view: RenderedView, materials: Materials) -> list[Path]:
    """Write the abundances of a view: (H, W, K) float32, summing to the opacity, 0 where nothing is; and a figure.

    Raises:
        RunError: the disk is full or refuses.
    """
    array_path, figure_path = abundance_paths(folder, name)
    write_file(array_path, array_bytes(view.abundances.numpy().astype(np.float32)))
    write_file(figure_path, draw_abundances(name, view, materials))
    return [array_path, figure_path]


def draw_abundances(name: str, view: RenderedView, materials: Materials) -> bytes:
    """A figure of a view in colour and of the abundances of what is seen, fading where nothing is."""
    swatches = endmember_colours(materials)
    kind = "colour" if colour_mode(materials.bands) == "true-colour" else "false colour"
    panels = [Panel(picture(view.spectra, view.accumulation, materials.bands), kind)]
    titles = [f"endmember {index}" for index in range(len(swatches))]
    panels += share_panels(view.shares, view.accumulation, titles, swatches)
    return draw_panels(in_rows(panels), f"{name}: abundances", SHARE_SCALE)


def share_panels(
    shares: Float[Tensor, "H W K"],
    opacity: Float[Tensor, "H W"],
    titles: Sequence[str],
    swatches: Float[np.ndarray, "K 3"],
) -> list[Panel]:
    """A panel for each material: its share of what is seen, faded by opacity."""
    images = [paint(image, SHARE_SCALE) for image in np.moveaxis(as_numpy(shares), -1, 0)]
    return [
        Panel(over_neutral(image, as_numpy(opacity)), title, swatch)
        for image, title, swatch in zip(images, titles, swatches, strict=True)
    ]
