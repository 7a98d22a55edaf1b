"""What training pixels are worth, band by band, and what a user should know of them before training.

Notation: `B` bands of the scene, `P` points, `R` pixels.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float

from unmix_plugin.scenes.pixel_table import PixelTable
from unmix_plugin.scenes.reading.sensors import lonely_sensors
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.band_noise import BandNoise, judge_bands
from unmix_plugin.spectral.evidence import relative_power_of

_PIXELS_TO_JUDGE_BY = 20_000
LEAST_OVERLAP = 0.1
"""Share of what a sensor sees that another must see too."""
_MOST_POINTS = 4000
_FEWEST_BAD = 1e-5
"""Share of bad values below which nothing is said."""


def judge_sensors(scene: Scene, table: PixelTable, seed: int) -> dict[int, BandNoise]:
    """The bands of each sensor that has bands of the scene for channels."""
    found = {}
    for sensor in table.shares:
        if scene.sensors[sensor].bands is not None:
            pixels = torch.from_numpy(table.sample_opaque(sensor, _PIXELS_TO_JUDGE_BY, seed))
            found[sensor] = judge_bands(pixels)
    return found


def band_weights(scene: Scene, noise: dict[int, BandNoise]) -> Float[np.ndarray, " B"]:
    """Of squared errors in each band; where several sensors see a band, the least."""
    weights = np.full(len(scene.wavelengths_nm), np.inf, dtype=np.float32)
    for sensor, found in noise.items():
        bands = list(scene.sensors[sensor].bands or ())
        weights[bands] = np.minimum(weights[bands], found.weights.numpy())
    return np.where(np.isfinite(weights), weights, 1.0).astype(np.float32)


def relative_power(scene: Scene, opaque: Float[np.ndarray, "R B"]) -> float:
    """Of brightness, by which squared errors are divided.

    Without alpha black may be nothing at all, so that errors of dark pixels must not count more: 0.
    """
    knows_empty = scene.has_alpha and not scene.is_unbounded
    return relative_power_of(torch.from_numpy(opaque)) if knows_empty else 0.0


def noise_warnings(scene: Scene, noise: dict[int, BandNoise], bad_share: float) -> list[str]:
    """Bands that are mostly noise or dead, and how many values were replaced."""
    said = []
    for sensor, found in noise.items():
        bands = scene.wavelengths_nm[list(scene.sensors[sensor].bands or ())]
        whose = f" of sensor {scene.sensors[sensor].name!r}" if scene.is_rig else ""
        for chosen, what, why in (
            (found.mostly_noise, "mostly noise", "hardly count in training"),
            (found.dead, "dead", "show one value everywhere and hardly count in training"),
        ):
            if bool(chosen.any()):
                named = ", ".join(f"{nm:g}" for nm in bands[chosen.numpy()])
                verb = "bands at {} nm{} are {}" if int(chosen.sum()) > 1 else "band {} nm{} is {}"
                said.append(
                    f"{verb.format(named, whose, what)}: its errors {why}; leave it out where you can"
                )
    if bad_share > _FEWEST_BAD:
        said.append(
            f"{bad_share:.2g} of all measured values stand out from the bands and pixels around them (stripes, "
            "spikes); training uses what is around them instead (--pipeline.datamanager.no-mend-values keeps them)"
        )
    return said


def rig_warnings(scene: Scene, reachable: Bool[np.ndarray, "R R R"]) -> list[str]:
    """Sensors of a rig that share no band with another, or look at other parts of the scene.

    Args:
        reachable: Cells of the scene box where something may be.
    """
    used = {scene.frames[view].sensor for view in scene.train_indices}
    alone = lonely_sensors(scene.sensors, used)
    said = []
    if alone:
        said.append(
            f"no other sensor shares a band with {', '.join(alone)}: only their poses hold their spectra together"
        )
    for name, share in _overlaps(scene, sorted(used), reachable):
        if share < LEAST_OVERLAP:
            said.append(
                f"of what sensor {name!r} sees, the other sensors see {share:.0%} (expected at least "
                f"{LEAST_OVERLAP:.0%}): nothing joins their spectra; check the poses and lenses of the rig"
            )
    return said


def _overlaps(
    scene: Scene, sensors: list[int], reachable: Bool[np.ndarray, "R R R"]
) -> list[tuple[str, float]]:
    """Names of sensors, and of the places that each sees the share that another sees too."""
    cells = np.argwhere(reachable)
    cells = cells[:: max(1, -(-len(cells) // _MOST_POINTS))]
    unit = torch.from_numpy((cells + 0.5) / np.array(reachable.shape)).float()
    points = scene.scene_box.aabb[0] + unit * scene.scene_box.size
    seen = {sensor: _seen(scene, sensor, points) for sensor in sensors}
    found = []
    for sensor in sensors if len(sensors) > 1 else []:
        others = np.any([seen[other] for other in sensors if other != sensor], axis=0)
        share = float((seen[sensor] & others).sum() / max(seen[sensor].sum(), 1))
        found.append((scene.sensors[sensor].name, share))
    return found


def _seen(scene: Scene, sensor: int, points: Float[torch.Tensor, "P 3"]) -> Bool[np.ndarray, " P"]:
    """Points that lie within some training picture of a sensor."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for view in scene.train_indices:
        if scene.frames[view].sensor == sensor:
            coords, depths = scene.cameras.project(points, view)
            seen |= (
                (depths > 0)
                & (coords >= 0).all(dim=-1)
                & (coords < torch.tensor(scene.cameras.size(view))).all(dim=-1)
            )
    return seen.numpy()
