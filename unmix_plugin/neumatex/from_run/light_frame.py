"""In which axes the light of an object stands still: those of the world, of a turntable, or of the camera.

Shading is explained in each of them. The run believed one when it was trained; where another leaves clearly less of the
shading unexplained, the run is contradicted, and the caller says so.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.engine import Cameras, Decision
from unmix_plugin.light.lamp import LAMP_FRAMES
from unmix_plugin.light.search import turning_axis
from unmix_plugin.neumatex.fit.data_manager import PixelList
from unmix_plugin.neumatex.fit.object_scene import PosedObject
from unmix_plugin.neumatex.fit.start import RunMaterials
from unmix_plugin.neumatex.from_run.light import LitPoints, find_light
from unmix_plugin.neumatex.tracing.environment import MovingFrame
from unmix_plugin.neumatex.tracing.lamp_and_sky import LampAndSky
from unmix_plugin.neumatex.tracing.rays import RayMesh

_NUM_POINTS, _MOST_PIXELS, _SEED = 5000, 2_000_000, 0
"""Pixels that the light is found from, and of how many they are drawn."""
_CLEARLY_LESS = 2 / 3
"""Squared error of the shading in another frame over that in the run's, from which the run is taken to be wrong: on
six objects the right frame had 0.12 to 0.46 times the least error in a wrong one."""
_SPECTRUM = {True: "of the scene", False: "unknown, taken as flat: give --pipeline.datamanager.lamp"}
_MOVES_WITH = {None: "nothing", "turntable": "the turntable", "camera": "the camera"}


@dataclass(frozen=True)
class FramedLight:
    """The light of an object, and the axes in which it stands still."""

    light: LampAndSky
    """Relative to the lamp's spectrum."""
    radiance: Float[Tensor, "H W B"]
    """The same as an environment map of all bands."""
    frame: MovingFrame | None
    """None: the axes of the world."""
    contradicts_run: bool
    """Whether the run took it for the other kind, still or moving."""
    decision: Decision


def framed_light(
    known: PosedObject, run: RunMaterials, white: float | None, run_says_moving: bool
) -> FramedLight:
    """The light that explains the shading best.

    Args:
        known: Mesh, cameras and pictures.
        run: Which tells what each point is made of.
        white: What a white surface reads that is lit best, where a reference says so.
        run_says_moving: Whether the run was trained with light that moves with the camera.
    """
    assert known.bands is not None
    ray_mesh, cameras = RayMesh(known.mesh), known.pictures.cameras[list(known.split.train)]
    lit, eyes = _seen_points(known, cameras, ray_mesh, run)
    lamp = np.ones(len(known.bands)) if known.lamp is None else known.lamp
    power = torch.from_numpy(lamp).float()
    reflectances = run.reflectances(known.bands, lamp, lit.abundances.shape[1])
    middle, axis = turning_axis(cameras)
    frames = [None, *(MovingFrame(kind, middle, axis) for kind in LAMP_FRAMES)]
    lights = [
        find_light(
            ray_mesh,
            replace(lit, light_axes=None if frame is None else frame.axes(eyes)),
            reflectances,
            power,
            white,
        )
        for frame in frames
    ]
    order = sorted(range(len(frames)), key=lambda number: lights[number].error)
    best = order[0]
    of_run = next(number for number in order if (frames[number] is not None) == run_says_moving)
    contradicts = lights[best].error < _CLEARLY_LESS * lights[of_run].error
    chosen = best if contradicts else of_run
    found, frame = lights[chosen], frames[chosen]
    others = [each.error for number, each in enumerate(lights) if number != chosen]
    evidence = {
        **found.decision.evidence,
        "spectrum of the lamp": _SPECTRUM[known.lamp is not None],
        "moves with": _MOVES_WITH[None if frame is None else frame.kind],
        "least squared error in another frame over this": min(others) / found.error,
        "the run took it to move": run_says_moving,
    }
    return FramedLight(
        light=found.light,
        radiance=found.light.radiance() * power,
        frame=frame,
        contradicts_run=contradicts,
        decision=replace(found.decision, evidence=evidence),
    )


def _seen_points(
    known: PosedObject, cameras: Cameras, ray_mesh: RayMesh, run: RunMaterials
) -> tuple[LitPoints, Float[Tensor, "N 3"]]:
    """Points of the surface that training pixels show, and where each was seen from."""
    generator = torch.Generator().manual_seed(_SEED)
    views, places, spectra = PixelList(known, _MOST_PIXELS, _SEED).draw(_NUM_POINTS, generator)
    rays = cameras.generate_rays(views, places)
    found, points = ray_mesh.seen(rays.origins, rays.directions)
    corners = known.frame.to_world(np.concatenate([np.zeros((1, 3)), np.eye(3)]))
    abundances = run.abundances(points.positions, points.geometric_normals, corners)
    return LitPoints(points, spectra[found], abundances), rays.origins[found]
