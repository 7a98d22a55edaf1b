"""What the training views tell of a scene before any training: its poses, what is empty, and its light."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from unmix_plugin.light.search import find_lamp
from unmix_plugin.scenes.evidence import AlphaEvidence
from unmix_plugin.scenes.geometry.carving import Cells, Masks, carve, carve_by_masks
from unmix_plugin.scenes.geometry.lighting import LightKind, judge_exposure, judge_light
from unmix_plugin.scenes.geometry.matched_points import find_matched_points
from unmix_plugin.scenes.geometry.surface_evidence import SurfaceEvidence, SweptDepths, sweep_scene
from unmix_plugin.scenes.geometry.view_agreement import compare_scene_conventions, training_views
from unmix_plugin.scenes.scene import Scene


@dataclass(frozen=True)
class JudgedViews:
    """What training views tell."""

    conventions: dict[str, float]
    """How little they agree under each convention of poses."""
    depths: SweptDepths | None
    """Where surfaces are, in an unbounded world."""
    reachable: Cells
    """Where something may be."""
    contradicted: float
    """Share of the foreground that masks contradict; 0 where nothing was carved by them."""
    light: LightKind
    lamp: tuple[float, ...]
    """Numbers of the lamp that moves with the camera; none if it is not known."""


def judge_views(scene: Scene, foreground: Masks | None, cells: int, evidence: AlphaEvidence) -> JudgedViews:
    """All of it.

    Args:
        foreground: For each training view True where something may be; None where nothing tells.
        cells: Along an edge of what is carved.
        evidence: Of pixels with alpha, for their light.
    """
    depths, contradicted = sweep_scene(scene), 0.0
    if foreground is None or scene.is_unbounded:
        reachable = carve(scene, cells, foreground)
    else:
        cameras = scene.cameras[list(scene.train_indices)]
        reachable, contradicted = carve_by_masks(cameras, foreground, scene.scene_box, cells)
    reachable = SurfaceEvidence(scene, depths, torch.device("cpu")).carved(reachable)
    light, lamp = (
        _judge_light(scene, reachable, evidence) if scene.has_alpha else (_judge_exposure(scene), ())
    )
    return JudgedViews(
        conventions=compare_scene_conventions(scene),
        depths=depths,
        reachable=reachable,
        contradicted=0.0 if scene.has_backdrop else contradicted,  # a backdrop was tried by that
        light=light,
        lamp=lamp,
    )


def _judge_light(
    scene: Scene, reachable: Cells, evidence: AlphaEvidence
) -> tuple[LightKind, tuple[float, ...]]:
    """By the views of the sensor that took most; and where the lamp is if it moves with the camera."""
    views, seen = evidence.log_brightness()
    cameras = scene.cameras[list(scene.train_indices)][views]
    light = judge_light(cameras, seen, reachable, scene.scene_box)
    if light != "camera":
        return light, ()
    lamp = find_lamp(cameras, evidence.log_shading(), reachable, scene.scene_box)
    return light, () if lamp is None else lamp.numbers()


def _judge_exposure(scene: Scene) -> LightKind:
    """Of views without alpha: whether matched places say that they differ in exposure."""
    views = training_views(scene)
    points = find_matched_points(views)
    if points is None:
        return "fixed"
    return judge_exposure(views.cameras, points.places, points.seen_by(len(views.cameras)))
