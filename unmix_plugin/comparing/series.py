"""Several captures of one object, each compared with the first: a table per region and material."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool

from unmix_plugin.comparing.comparison import Comparison
from unmix_plugin.comparing.places import amount_over, angle_over
from unmix_plugin.trained.measured_surface import points_in
from unmix_plugin.trained.regions import OfMaterial


def regions_of(comparison: Comparison) -> dict[str, Bool[np.ndarray, " P"]]:
    """Vertices of the first surface: all of it, each kept region of the first run, and each of its materials."""
    capture, surface = comparison.before, comparison.surface
    largest = surface.abundances.argmax(axis=1)
    model = torch.from_numpy(capture.scene.frame.to_model(surface.positions)).float()
    found: dict[str, Bool[np.ndarray, " P"]] = {"everything": np.ones(len(largest), bool)}
    for name, region in capture.regions.items():
        if isinstance(region, OfMaterial):
            found[name] = largest == region.material
        else:
            found[name] = points_in(capture.scene, region, model)
    for index, name in enumerate(capture.scene.materials.names):
        found[f"material {name}"] = largest == index
    return {name: chosen for name, chosen in found.items() if chosen.any()}


def series_rows(comparisons: Sequence[Comparison], names: Sequence[str]) -> Iterable[Sequence[object]]:
    """A row for each region and each later capture: what changed since the first, with intervals."""
    quantities = list(
        dict.fromkeys(name for one in comparisons for name in one.differences if name != "spectrum")
    )
    head = ["region", "capture", "area", "changed_part", "spectral_angle_rad"]
    for name in quantities:
        plain = "brightness_factor" if name == "brightness" else name.replace(" ", "_")
        head += [plain, f"{plain}_low", f"{plain}_high"]
    yield head
    regions = regions_of(comparisons[0])
    for region, chosen in regions.items():
        for comparison, capture in zip(comparisons, names, strict=True):
            yield [region, capture, *_numbers(comparison, chosen, quantities)]


def _numbers(
    comparison: Comparison, chosen: Bool[np.ndarray, " P"], quantities: Sequence[str]
) -> Iterable[str]:
    vertices, areas = np.flatnonzero(chosen), comparison.surface.areas
    known = areas[chosen & comparison.known].sum()
    changed = areas[chosen & comparison.changed].sum() / known if known > 0 else np.nan
    values = [areas[vertices].sum(), changed, angle_over(comparison.spectra, vertices)]
    differences: Mapping = comparison.differences
    for name in quantities:
        if name in differences:
            amount = amount_over(name, differences[name], vertices, areas)
            values += [amount.mean, amount.low, amount.high]
        else:
            values += [np.nan] * 3
    return [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
