"""Abundance maps: arrays, images for other programs, and a figure of every view."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.figures.pictures import (
    ColourScale,
    TitledPicture,
    draw_panels,
    in_rows,
    over_neutral,
    paint,
)
from unmix_plugin.formats.envi import envi_cube_paths, write_envi_cube
from unmix_plugin.formats.exr import layer_names, write_exr
from unmix_plugin.formats.files import array_bytes, write_file
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Abundances
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import colour_mode
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.trained.evaluation import PredictedView, as_numpy, picture
from unmix_plugin.trained.run_materials import endmember_colours

SHARE_SCALE = ColourScale("viridis", 0.0, 1.0, "abundance")
"""Colours of abundances, the same in every figure."""


def export(job: Job, asked: Abundances) -> list[Path]:
    """Write the abundances of views: npy, envi and exr hold the same float32 numbers, png is a figure."""
    return job.write_views(
        asked.views, partial(view_paths, asked.formats), partial(_write_view, asked.formats)
    )


def _write_view(
    formats: Sequence[str], folder: Path, view: str, rendered: PredictedView, materials: Materials
) -> None:
    shares = rendered.abundances.numpy().astype(np.float32)
    about = f"{view}: abundances, summing to the opacity"
    for kind in formats:
        path = folder / f"{view}.{kind}"
        if kind == "npy":
            write_file(path, array_bytes(shares))
        elif kind == "png":
            write_file(path, draw_abundances(view, rendered, materials))
        elif kind == "envi":
            write_envi_cube(folder / view, shares, None, materials.names, about)
        else:
            names = layer_names("abundances", materials.names)
            planes = dict(zip(names, np.moveaxis(shares, -1, 0), strict=True))
            write_exr(path, planes, {"comments": about})


def view_paths(formats: Sequence[str], folder: Path, view: str) -> list[Path]:
    """Files of a view: ENVI has two, the other formats one."""
    return [
        path
        for kind in formats
        for path in (envi_cube_paths(folder / view) if kind == "envi" else [folder / f"{view}.{kind}"])
    ]


def colour_panel(view: PredictedView, bands: Bands) -> TitledPicture:
    """A view as an eye, or a camera with these bands, sees it."""
    title = "colour" if colour_mode(bands) == "true-colour" else "false colour"
    return TitledPicture(picture(view.spectra, view.coverage, bands), title)


def draw_abundances(name: str, view: PredictedView, materials: Materials) -> bytes:
    """A figure of a view in colour and of the abundances of what is seen, fading where nothing is."""
    panels = [colour_panel(view, materials.bands)]
    panels += share_panels(view.shares, view.accumulation, materials.names, endmember_colours(materials))
    return draw_panels(in_rows(panels), f"{name}: abundances", SHARE_SCALE)


def share_panels(
    shares: Float[Tensor, "H W K"],
    opacity: Float[Tensor, "H W"],
    titles: Sequence[str],
    swatches: Float[np.ndarray, "K 3"],
) -> list[TitledPicture]:
    """A panel for each material: its share of what is seen, faded by opacity."""
    images = [paint(image, SHARE_SCALE) for image in np.moveaxis(as_numpy(shares), -1, 0)]
    return [
        TitledPicture(over_neutral(image, as_numpy(opacity)), title, swatch)
        for image, title, swatch in zip(images, titles, swatches, strict=True)
    ]
