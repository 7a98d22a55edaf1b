"""Products with files for every view: abundances, spectral images, segmentations. Numbers are written as `save` does.

Notation: `H x W` pixels, `K` endmembers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from unmix_plugin.engine.outputs import Output
from unmix_plugin.figures.look import NEUTRAL
from unmix_plugin.figures.paint import paint, scale_of
from unmix_plugin.figures.pictures import Picture, TitledPicture, draw_panels, in_rows
from unmix_plugin.formats.envi import envi_cube_paths
from unmix_plugin.formats.files import array_bytes, write_file
from unmix_plugin.products.product import Job
from unmix_plugin.products.render.pictures import legend_csv
from unmix_plugin.products.save import save
from unmix_plugin.products.scene_products import Abundances, Cubes, Segmentation
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import colour_mode
from unmix_plugin.spectral.materials import Materials
from unmix_plugin.spectral.segmentation import NOTHING_ID
from unmix_plugin.trained.evaluation import PredictedView, picture, predicted_view
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.trained_scene import MaterialView

SHARE = Output("abundance", "map", "abundance", "abundance", (0.0, 1.0))
"""A material's part of what is seen, in the same colours in every figure."""
SHARE_SCALE = scale_of(SHARE)


def abundances(job: Job, asked: Abundances) -> list[Path]:
    """Write the abundances of views: npy, envi and exr hold the same float32 numbers, png is a figure."""

    def write(name: str, view: MaterialView) -> None:
        _save(job.folder, [kind for kind in asked.formats if kind != "png"], "abundances", name, view)
        if "png" in asked.formats:
            figure = draw_abundances(name, predicted_view(view), job.materials)
            write_file(job.folder / f"{name}.png", figure)

    return job.write_views(asked.views, partial(_paths, job.folder, asked.formats), write)


def cubes(job: Job, asked: Cubes) -> list[Path]:
    """Write the spectra of views."""
    paths = partial(_paths, job.folder, asked.formats)
    return job.write_views(asked.views, paths, partial(_save, job.folder, asked.formats, "spectral"))


def segmentation(job: Job, asked: Segmentation) -> list[Path]:
    """Write scores, figure and ids of views, and the legend of the ids."""
    entries = zip(job.materials.names, endmember_colours(job.materials), strict=True)
    path, legend = job.folder / "legend.csv", legend_csv(entries, nothing=(NEUTRAL,) * 3)
    if not (path.is_file() and path.read_bytes() == legend):  # other views of the same run have the same
        job.claim([path])

    def paths(name: str) -> list[Path]:
        figures = [job.folder / f"{name}.{kind}" for kind in ("npy", "png")]
        return [*figures, job.folder / "labels" / f"{name}.png"]

    def write(name: str, view: MaterialView) -> None:
        scores, figure, labels = paths(name)
        seen = predicted_view(view)
        write_file(scores, array_bytes(segmentation_scores(seen, job.materials).numpy().astype(np.float32)))
        write_file(figure, draw_segmentation(name, seen, job.materials))
        save(view, "segmentation", labels)

    written = job.write_views(asked.views, paths, write)
    if job.processes.is_first:
        write_file(path, legend)
    return [*written, path]


def _paths(folder: Path, formats: Sequence[str], view: str) -> list[Path]:
    """Files of a view: ENVI has two, the other formats one."""
    own = {
        kind: envi_cube_paths(folder / view) if kind == "envi" else [folder / f"{view}.{kind}"]
        for kind in formats
    }
    return [path for paths in own.values() for path in paths]


def _save(folder: Path, formats: Sequence[str], output: str, name: str, view: MaterialView) -> None:
    for kind in formats:
        save(view, output, _paths(folder, [kind], name)[0], label=name)


def segmentation_scores(view: PredictedView, materials: Materials) -> Float[Tensor, "H W K"]:
    """What the ids are chosen by: abundances, or cosines to the endmembers (0 where nothing is)."""
    if materials.segmentation == "abundances":
        return view.abundances
    return view.material_scores * (view.segmentation != NOTHING_ID)[..., None]


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
    images = shares.unbind(dim=-1)
    return [
        TitledPicture(paint(SHARE, image, opacity).picture(), title, swatch)
        for image, title, swatch in zip(images, titles, swatches, strict=True)
    ]


def paint_ids(
    ids: UInt8[Tensor | np.ndarray, "H W"], names: Sequence[str], colours: Float[np.ndarray, "K 3"]
) -> Picture:
    """Each id in the colour of its class, grey where nothing is."""
    classes = tuple(zip(names, map(tuple, colours.tolist()), strict=True))
    output = Output("segmentation", "labels", "segmentation", "index of the material", classes=classes)
    return paint(output, ids, np.ones(ids.shape)).picture()


def draw_segmentation(name: str, view: PredictedView, materials: Materials) -> bytes:
    """A figure of a view in colour and of its materials, with a legend of those that occur."""
    colours, ids = endmember_colours(materials), view.segmentation.numpy()
    painted = TitledPicture(paint_ids(view.segmentation, materials.names, colours), "materials")
    present = [index for index in range(len(colours)) if (ids == index).any()]
    legend = [(materials.names[index], colours[index]) for index in present]
    panels = [[colour_panel(view, materials.bands), painted]]
    return draw_panels(panels, f"{name}: segmentation", legend=legend)
