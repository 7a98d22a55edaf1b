"""Principal components of spectra or abundances as colours, with one basis and one stretch for all views.

Notation: `H x W` pixels, `C` bands or endmembers, `N` pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.figures.pictures import over_neutral
from unmix_plugin.formats.files import csv_bytes, eight_bits, rgba_png_bytes, write_file
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Pca
from unmix_plugin.spectral.materials import OCCUPIED_ACCUMULATION, Materials
from unmix_plugin.spectral.subspace import PcaColours
from unmix_plugin.trained.evaluation import PredictedView, as_numpy
from unmix_plugin.trained.trained_scene import TrainedScene

_PcaOf = Literal["spectra", "abundances"]
_PIXELS = 48 * 48
"""Of each view that the components are found from."""
_LEAST_EXPLAINED = 1e-6
"""Part of the variance that a component has to explain to be shown."""


def export(job: Job, asked: Pca) -> list[Path]:
    """Find the components of all views, then paint each."""
    views, table = job.views(asked.views), job.folder / "components.csv"
    paths = [job.folder / f"{view.name}.png" for view in views]
    job.claim([*paths, table])
    seen = [_survey_view(job.scene, one.camera, asked.of) for one in job.follow("finding components", views)]
    components = _find_components(seen, asked.of)
    for view, path in zip(job.follow("rendering views", views), paths, strict=True):
        write_file(path, _painted(view.name, job.render(view), components))
    return [*paths, write_file(table, _table(components, job.materials))]


@dataclass(frozen=True)
class _Components:
    """Three components, and how much they tell."""

    of: _PcaOf
    colours: PcaColours
    explained: tuple[float, float, float]
    """Part of the variance that lies along each."""


def _survey_view(scene: TrainedScene, camera: Cameras, of: _PcaOf) -> Float[Tensor, "N C"]:
    """What a small render of a view shows where something is: spectra, or abundances that sum to 1."""
    outputs = scene.render(camera.shrunk(_PIXELS), ("spectral", "abundances", "accumulation"))
    accumulation = outputs["accumulation"]
    seen = accumulation > OCCUPIED_ACCUMULATION
    values = outputs["spectral" if of == "spectra" else "abundances"][seen]
    return (values if of == "spectra" else values / accumulation[seen][:, None]).cpu()


def _find_components(values: Sequence[Float[Tensor, "_ C"]], of: _PcaOf) -> _Components:
    """The components of what all views show."""
    together = torch.cat(list(values)).double()
    colours = PcaColours.fit(together)
    centred = together - colours.mean
    total = max(float(centred.square().sum()), 1e-300)
    along = (centred @ colours.axes).square().sum(dim=0)
    first, second, third = (along / total).tolist()
    # What is left of abundances that sum to 1, or of mixtures of few spectra, is rounding: it would be drawn as noise.
    tells = (torch.tensor([first, second, third]) > _LEAST_EXPLAINED).double()
    high = colours.high * tells + (1 - tells)
    colours = PcaColours(colours.mean, colours.axes * tells, colours.low * tells, high)
    return _Components(of, colours, (first, second, third))


def _painted(name: str, view: PredictedView, components: _Components) -> bytes:
    """A view's components as red, green and blue, fading into grey where nothing is; a PNG, a pixel a pixel."""
    values = view.spectra if components.of == "spectra" else view.shares
    colours = as_numpy(components.colours(values.double()))
    painted = over_neutral(colours, as_numpy(view.accumulation))
    what = (
        f"{name}: three principal components of the {components.of}, each from its 1st to its 99th percentile"
    )
    return rgba_png_bytes(eight_bits(painted), what)


def _table(components: _Components, materials: Materials) -> bytes:
    """What red, green and blue stand for: a row for each band or endmember, with its mean and its weight in each
    component; then the values that become 0 and 1, and the part of the variance that each component explains."""
    colours = components.colours
    of_spectra = components.of == "spectra"
    names = [f"{nm:g}" for nm in materials.bands.centers_nm] if of_spectra else list(materials.names)
    rows = [["wavelength" if of_spectra else "endmember", "mean", "red", "green", "blue"]]
    for name, mean, axes in zip(names, colours.mean.tolist(), colours.axes.tolist(), strict=True):
        rows.append([name, f"{mean:.9g}", *(f"{value:.9g}" for value in axes)])
    ends = {"value of 0": colours.low.tolist(), "value of 1": colours.high.tolist()}
    for name, row in {**ends, "explained variance": components.explained}.items():
        rows.append([name, "", *(f"{value:.9g}" for value in row)])
    return csv_bytes(rows)
