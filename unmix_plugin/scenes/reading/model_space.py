"""From the space of transforms.json to model space: which box the training views show, and whether the world goes on
behind it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64

from unmix_plugin.engine.decisions import Decision
from unmix_plugin.engine.geometry.camera_paths import meeting_point
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.backdrop_trial import NO_BACKDROP, try_backdrop
from unmix_plugin.scenes.backdrops import BeforeBackdrop
from unmix_plugin.scenes.doctor import check_poses
from unmix_plugin.scenes.folder import CUBE_KEY
from unmix_plugin.scenes.geometry.bounds import find_bounds
from unmix_plugin.scenes.geometry.matched_points import find_matched_points
from unmix_plugin.scenes.geometry.view_agreement import compare_conventions, find_world_evidence
from unmix_plugin.scenes.geometry.views import Views, commonest
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.placement import Normalisation
from unmix_plugin.scenes.reading.checks import CheckedFiles
from unmix_plugin.scenes.reading.cubes import read_cube
from unmix_plugin.scenes.reading.entries import SceneEntry
from unmix_plugin.settings import SceneOptions

_FAR_OFF, _MOST_FAR_OFF = 20.0, 0.1
"""Distance of a camera from the others' middle, in the distance within which most others are, from which on its pose is
taken for wrong; and the largest share of the views that this may hold for."""
_LEAST_PLACES = 10
"""Of cameras; among fewer none is called far off."""


def _poses_of(entry: SceneEntry) -> Float64[np.ndarray, "N 3 4"]:
    """One pose a frame, as transforms.json has it."""
    return np.stack([frame.camera.pose for frame in entry.frames if frame.camera.pose is not None])


def without_far_off(entry: SceneEntry, train: tuple[int, ...]) -> tuple[tuple[int, ...], str | None]:
    """Training views without those whose cameras are so far off that only a wrong pose explains it, and what to say."""
    if any(frame.camera.pose is None for frame in entry.frames):
        return train, None
    positions = _poses_of(entry)[list(train), :, 3]
    shots = [entry.frames[view].shot or place.tobytes() for view, place in zip(train, positions, strict=True)]
    places = np.stack(list(dict(zip(shots, positions, strict=True)).values()))  # a rig's lenses share one
    middle = np.median(places, axis=0)
    usual = float(np.quantile(np.linalg.norm(places - middle, axis=1), 1 - _MOST_FAR_OFF, method="lower"))
    distances = np.linalg.norm(positions - middle, axis=1)
    is_off = (distances > _FAR_OFF * usual) & (usual > 0) & (len(places) >= _LEAST_PLACES)
    if not is_off.any():
        return train, None
    names = ", ".join(entry.frames[train[row]].files[CUBE_KEY].name for row in np.flatnonzero(is_off))
    warning = Message.FAR_OFF_POSE.sentence(views=names, times=distances.max() / usual)
    return tuple(view for view, off in zip(train, is_off, strict=True) if not off), warning


@dataclass(frozen=True)
class ModelSpace:
    """What is modelled, as `Scene` has it; the similarity starts from the space of transforms.json."""

    normalisation: Normalisation
    scene_box: SceneBox
    is_unbounded: bool
    before_backdrop: BeforeBackdrop | None
    world_reason: str | None
    decisions: tuple[Decision, ...]
    warnings: tuple[str, ...]


def find_model_space(
    root: Path, entry: SceneEntry, checked: CheckedFiles, train: tuple[int, ...], options: SceneOptions
) -> ModelSpace:
    """The box that the training views show, how its longest edge becomes [-1, 1], and what lies behind it.

    The box is found in a space centred on the training cameras, where coordinates are of order 1. Raises SceneError:
    alpha and poses contradict.
    """
    views = [checked.frames[index] for index in train]
    poses = _poses_of(entry)[list(train)]
    middle = poses[:, :, 3].mean(axis=0)
    radius = float(np.linalg.norm(poses[:, :, 3] - middle, axis=-1).max())
    first = Normalisation(np.eye(3), -middle, 1.0 / radius if radius > 0.0 else 1.0)
    cameras = entry.cameras(checked.sizes, first)[list(train)]
    foreground = [view.foreground for view in views if view.foreground is not None] or None
    alike = commonest([view.sensor for view in views])

    def read_view(row: int, part: tuple[slice, ...]) -> Float32[np.ndarray, "H W B"]:
        return read_cube(views[alike[row]].cube, options, part)

    def read_valid(row: int) -> Bool[np.ndarray, "H W"]:
        view = views[alike[row]]
        return np.ones(view.size, dtype=bool) if view.unknown is None else ~view.unknown

    compared = Views(cameras[alike], read_view, read_valid)
    box = points = None
    looked_for = foreground is None and options.world == "auto" and len(alike) == len(train)
    backdrop = try_backdrop(compared) if looked_for else NO_BACKDROP
    before, box = backdrop.before, backdrop.box
    has_masks = box is not None or foreground is not None
    if not has_masks and meeting_point(cameras.camera_to_world.double().numpy()) is None:
        points = find_matched_points(compared)
        points = None if points is None else replace(points, pairs=torch.tensor(alike)[points.pairs])
    try:
        box = box or find_bounds(cameras, foreground, points)
    except SceneError as error:
        hint = check_poses(compare_conventions(poses[alike], compared))
        raise SceneError(f"{root}: {error}" + ("" if hint is None else f"\n{hint.sentence()}")) from error
    is_unbounded, reason = options.world == "unbounded", None
    decisions = [] if backdrop.decision is None else [backdrop.decision]
    if options.world == "auto" and not has_masks and not (points and points.are_equally_far):
        evidence = replace(find_world_evidence(box, compared), has_plain_sides=backdrop.is_refuted)
        if not evidence.goes_on:
            places = points or find_matched_points(compared)
            evidence = evidence if places is None else evidence.with_places(box, places.places)
        is_unbounded, reason = evidence.goes_on, evidence.in_words()
        decisions.append(evidence.decision)
    low, high = box.aabb.double().numpy()
    scale = float(2.0 / (high - low).max())
    half = 0.5 * scale * (high - low)
    translation = first.translation - 0.5 * (low + high) / first.scale
    normalisation = Normalisation(first.rotation, translation, first.scale * scale)
    own_box = SceneBox(torch.from_numpy(np.stack([-half, half])).float())
    return ModelSpace(
        normalisation=normalisation,
        scene_box=own_box,
        is_unbounded=is_unbounded,
        before_backdrop=before,
        world_reason=reason,
        decisions=tuple(decisions),
        warnings=backdrop.warnings,
    )
