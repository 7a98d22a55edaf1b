"""The layer of a spectral index: what is seen as one number a pixel, of its reflectance.

Notation: pictures are (H, W, 3) sRGB in [0, 1]; `N` reference rays.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.indices import SpectralIndex, parse_index
from unmix_plugin.spectral.materials import Coefficients, Materials
from unmix_plugin.trained.material_view import MaterialView
from unmix_plugin.viewer.layers.layer_aids import LayerAids
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.layers.painting import (
    ColourMapLegend,
    Legend,
    Picture,
    over_background,
    paint_values,
)
from unmix_plugin.viewer.rendering.reference import percentile_range

_CHUNK = 1 << 16
"""Pixels whose spectra are held at once."""

_LONGEST_LABEL = 120


def paint_index(frame: MaterialView, settings: LayerSettings, aids: LayerAids) -> tuple[Picture, Legend]:
    """The index that is chosen, over the background where it is undefined or hardly anything is seen.

    Raises:
        ConfigError: none is chosen, an unknown one, or a formula that can't be read.
        SpectrumError: the bands do not cover what it needs.
    """
    materials = frame.materials
    index = _chosen_index(settings, materials.bands)
    values = _index_values(index, frame)
    scale = (
        settings.value_range
        or index.usual_range
        or _seen_range(index, aids.reference.coefficients, materials)
    )
    what = index.what if len(index.what) <= _LONGEST_LABEL else f"{index.what[:_LONGEST_LABEL]}..."
    label = what if materials.light is not None else f"{what}; of radiance: light unknown"
    picture = paint_values(values, scale, settings.colour_map)
    opacity = frame.coefficients.accumulation * values.isfinite()
    return over_background(picture, opacity, settings), ColourMapLegend(settings.colour_map, *scale, label)


def _chosen_index(settings: LayerSettings, bands: Bands) -> SpectralIndex:
    if not settings.index:
        edges = bands.edges_nm
        raise ConfigError(
            f"no spectral index is chosen: type a formula of the wavelengths from {edges[0]:g} to {edges[-1]:g} nm "
            f"that the bands cover, such as r{float(bands.centers_nm[-1]):g}/r{float(bands.centers_nm[0]):g}"
        )
    return parse_index(settings.index, bands)


def _index_values(index: SpectralIndex, view: MaterialView) -> Float[Tensor, "H W"]:
    """The index of every pixel, chunk by chunk: the spectra of a whole picture may not fit into memory."""
    rows = view.coefficients.flatten()
    chunks = [rows.map(lambda _, part=part: part) for part in rows.packed.split(_CHUNK)]
    values = torch.cat([index(view.materials.reflectance(chunk)) for chunk in chunks])
    return values.unflatten(0, view.opacity.shape)


def _seen_range(index: SpectralIndex, reference: Coefficients, materials: Materials) -> tuple[float, float]:
    """From the 1st to the 99th percentile of the index of the reference rays."""
    values = index(materials.reflectance(reference))
    return percentile_range(values[values.isfinite()])
