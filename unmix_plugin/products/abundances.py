"""Abundance maps: an array and a figure a view."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.figures.picture_grid import ColourScale, Panel, draw_panels, in_rows, over_neutral, paint
from unmix_plugin.formats.envi_cube import envi_cube_paths, write_envi_cube
from unmix_plugin.formats.exr import write_exr
from unmix_plugin.formats.files import array_bytes, write_file
from unmix_plugin.products.product_formats import ShareFormat
from unmix_plugin.spectral.colour.conversion import colour_mode
from unmix_plugin.spectral.composition import Materials
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.view_rendering import RenderedView, as_numpy, picture

SHARE_SCALE = ColourScale("viridis", 0.0, 1.0, "abundance")
"""Colours of abundances, the same in every figure."""

_WHAT = "abundances, summing to the opacity"


_DEFAULT_FORMATS: tuple[ShareFormat, ...] = ("npy", "png")


def abundance_paths(folder: Path, name: str, formats: Sequence[ShareFormat] = _DEFAULT_FORMATS) -> list[Path]:
    """Files that `write_abundances` makes for a view."""
    return [path for kind in formats for path in _paths(folder / name, kind)]


def write_abundances(
    folder: Path,
    name: str,
    view: RenderedView,
    materials: Materials,
    formats: Sequence[ShareFormat] = _DEFAULT_FORMATS,
) -> list[Path]:
    """Write the abundances of a view: (H, W, K) float32, summing to the opacity, 0 where nothing is; and a figure.

    Args:
        folder: Where to write; it is made.
        name: Of the view.
        view: Rendered.
        materials: Of the model.
        formats: `npy`, `envi` and `exr` have the numbers, `png` is the figure.
    Raises:
        RunError: the disk is full or refuses.
    """
    written: list[Path] = []
    shares = view.abundances.numpy().astype(np.float32)
    for kind in formats:
        path = _paths(folder / name, kind)[0]
        if kind == "npy":
            written.append(write_file(path, array_bytes(shares)))
        elif kind == "png":
            written.append(write_file(path, draw_abundances(name, view, materials)))
        elif kind == "envi":
            written += write_envi_cube(
                path.with_suffix(""), shares, None, materials.names, f"{name}: {_WHAT}"
            )
        else:
            # A dot in a channel's name would part layers.
            channels = [f"abundances.{channel.replace('.', '_')}" for channel in materials.names]
            planes = dict(zip(channels, np.moveaxis(shares, -1, 0), strict=True))
            written.append(write_exr(path, planes, {"comments": f"{name}: {_WHAT}"}))
    return written


def draw_abundances(name: str, view: RenderedView, materials: Materials) -> bytes:
    """A figure of a view in colour and of the abundances of what is seen, fading where nothing is."""
    swatches = endmember_colours(materials)
    kind = "colour" if colour_mode(materials.bands) == "true-colour" else "false colour"
    panels = [Panel(picture(view.spectra, view.accumulation, materials.bands), kind)]
    panels += share_panels(view.shares, view.accumulation, materials.names, swatches)
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


def _paths(base: Path, kind: ShareFormat) -> list[Path]:
    return envi_cube_paths(base) if kind == "envi" else [base.with_name(f"{base.name}.{kind}")]
