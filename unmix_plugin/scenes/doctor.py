"""What looks wrong with a scene whose files are sound: each check once, for unmix-process and unmix-train alike.

A finding is a code with values; its sentence is made where it is printed, as advice differs from command to command.

Notation: `N` cameras, `P` points.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.errors import SceneError, counted, name_some
from unmix_plugin.scenes.geometry.bounds import find_bounds
from unmix_plugin.scenes.geometry.carving import MOST_CONTRADICTED, Cells, Masks, share_contradicted
from unmix_plugin.scenes.geometry.view_agreement import CONVENTIONS, GIVEN, LEAST_RATIO, MOST_DISAGREEMENT
from unmix_plugin.scenes.geometry.views import look_up
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bad_values import BandNoise

_SMALLEST_BASE = 2e-3
"""Distance between two cameras over that of what they see, below which it moves by hardly more than a pixel."""
_SAME_POSE = 1e-3
"""Difference of axes, and of places over how far cameras are apart, up to which poses are one."""
_MOST_COPIES = 5
"""Groups of copies that are named."""
_MOST_UNREACHED, _PIXELS_ASKED = 0.002, 2_500
"""Share of a picture that a lens may leave out; pixels by which that is judged."""
_LEAST_OVERLAP = 0.1
"""Share of what a sensor sees that another must see too."""
_MOST_POINTS = 4000
_FEWEST_BAD = 1e-5
"""Share of bad values below which nothing is said."""


@dataclass(frozen=True)
class Finding:
    """Something that looks wrong with a scene."""

    code: Message
    values: Mapping[str, Any] = field(default_factory=dict)
    """By the names in the template of the code."""

    @staticmethod
    def of(code: Message, **values: Any) -> Finding:
        """A finding with its values as keywords."""
        return Finding(code, values)

    def sentence(self, advice: str = "") -> str:
        """What was found, and what to do; `advice` is for the codes that leave it to the command."""
        return self.code.sentence(**self.values, advice=advice)


def check_poses(disagreements: Mapping[str, float]) -> Finding | None:
    """Whether the training views agree much better under another convention of poses than under the one expected.

    Args:
        disagreements: As `view_agreement.compare_conventions` has them.
    """
    best = min(disagreements, key=lambda name: disagreements[name], default=GIVEN)
    if best == GIVEN or disagreements[best] > MOST_DISAGREEMENT:
        return None
    found = disagreements[GIVEN]
    if found < LEAST_RATIO * disagreements[best]:
        return None
    return Finding.of(
        Message.POSES_OF_OTHER_CONVENTION,
        best=best,
        as_best=disagreements[best],
        given=GIVEN,
        as_given="they share nothing" if found == float("inf") else f"they differ by {found:.2f}",
        remedy=CONVENTIONS[best][2],
    )


def check_parallax(positions: Float[np.ndarray, "N 3"], box: SceneBox) -> Finding | None:
    """Whether all cameras, of a line camera at several rows, stand at one place."""
    apart = np.linalg.norm(positions - positions[0], axis=1).max()
    away = np.linalg.norm(np.abs(box.aabb.cpu().numpy() - positions[0]).max(axis=0))
    return None if apart > _SMALLEST_BASE * away else Finding.of(Message.CAMERAS_AT_ONE_PLACE)


def check_copies(
    names: Sequence[str], contents: Sequence[Hashable], poses: Float[np.ndarray, "N 3 4"]
) -> Iterator[Finding]:
    """Whether views are copies of each other, and whether their poses say otherwise.

    Args:
        contents: Of each view what is equal where its values are, such as a hash of its file.
        poses: Of each, of a line camera in its middle.
    """
    alike: dict[Hashable, list[int]] = defaultdict(list)
    for index, content in enumerate(contents):
        alike[content].append(index)
    # Places in units of how far the cameras are apart.
    extent = np.ptp(poses[:, :, 3], axis=0).max() if len(poses) else 0.0
    compared = poses / np.array([1.0, 1.0, 1.0, extent or 1.0])
    apart, together = [], []
    for copies in alike.values():
        if len(copies) > 1:
            differ = np.abs(compared[copies] - compared[copies[0]]).max() > _SAME_POSE
            (apart if differ else together).append(" = ".join(names[index] for index in copies))
    for code, found in ((Message.COPIES_POSED_APART, apart), (Message.COPIES, together)):
        if found:
            yield Finding.of(code, views=name_some(found, _MOST_COPIES))


def check_lenses(cameras: Cameras) -> Finding | None:
    """Whether a lens with distortion reaches less than the picture: no direction leads to the rest of it."""
    shares: dict[tuple[float, ...], float] = {}  # views mostly share a lens
    lost = []
    for index in range(len(cameras) if cameras.is_distorted else 0):
        if cameras.is_line_camera(index):
            continue
        camera = cameras[index]
        numbers = torch.cat([camera.focal_px, camera.center_px, camera.distortion], dim=1)
        lens = (camera.width, camera.height, *numbers[0].tolist())
        if lens not in shares:
            # Share of pixels that don't come back when what lies on their rays is projected.
            small = camera.shrunk(_PIXELS_ASKED)
            shares[lens] = 0.0
            if small.is_distorted:
                rays = small.image_rays(0)
                pixels, depths = small.project(rays.origins + rays.directions, 0)
                assert rays.pixel_coords is not None
                comes_back = (depths > 0) & ((pixels - rays.pixel_coords).norm(dim=1) < 1.0)
                shares[lens] = 1.0 - float(comes_back.float().mean())
        lost.append(shares[lens])
    if max(lost, default=0.0) <= _MOST_UNREACHED:
        return None
    views = counted(sum(share > _MOST_UNREACHED for share in lost), "view")
    return Finding.of(Message.LENS_FOLDS, views=views, lost=max(lost))


def contradicted_share(cameras: Cameras, foreground: Masks) -> tuple[SceneBox | None, float]:
    """The box of what masks show, and the share of it that other masks contradict; 1 without a box where they have
    nothing in common.

    Args:
        cameras: In a space where coordinates are of order 1.
        foreground: For each view True on pixels that may show something.
    """
    try:
        box = find_bounds(cameras, foreground)
    except SceneError:
        return None, 1.0
    return box, share_contradicted(cameras, foreground, box)


def check_masks(share: float) -> Finding | None:
    """Judge a share that masks contradict."""
    if share <= MOST_CONTRADICTED:
        return None
    return Finding.of(Message.MASKS_CONTRADICT, share=share, most=MOST_CONTRADICTED)


def check_bands(scene: Scene, noise: Mapping[int, BandNoise], bad_share: float) -> Iterator[Finding]:
    """Bands that are mostly noise or dead, and how many values were replaced.

    Args:
        noise: Of each sensor that has bands of the scene for channels.
        bad_share: Of all measured values.
    """
    for sensor, found in noise.items():
        bands = scene.wavelengths_nm[list(scene.sensors[sensor].bands or ())]
        whose = f" of sensor {scene.sensors[sensor].name!r}" if scene.is_rig else ""
        for chosen, what, why in (
            (found.mostly_noise, "mostly noise", "hardly count in training"),
            (found.dead, "dead", "show one value everywhere and hardly count in training"),
        ):
            named = ", ".join(f"{nm:g}" for nm in bands[chosen.numpy()])
            which = f"bands at {named} nm{whose} are" if "," in named else f"band {named} nm{whose} is"
            if named:
                yield Finding.of(Message.BANDS_OF_NO_USE, bands=which, what=what, why=why)
    if bad_share > _FEWEST_BAD:
        yield Finding.of(Message.VALUES_REPLACED, share=bad_share)


def check_rig(scene: Scene, reachable: Cells) -> Iterator[Finding]:
    """Sensors of a rig that share no band with another, or look at other parts of the scene: of cells where something
    may be."""
    used = sorted({scene.frames[view].sensor for view in scene.train_indices})
    if len(used) < 2:
        return
    bands = np.array([scene.sensors[index].seen_bands for index in used])
    is_shared = bands.sum(axis=0) > 1
    alone = [
        scene.sensors[row].name for row, own in zip(used, bands, strict=True) if not (own & is_shared).any()
    ]
    if alone:
        yield Finding.of(Message.SENSORS_WITHOUT_SHARED_BAND, sensors=", ".join(alone))
    cells = np.argwhere(reachable)
    cells = cells[:: max(1, -(-len(cells) // _MOST_POINTS))]
    unit = torch.from_numpy((cells + 0.5) / np.array(reachable.shape)).float()
    points = scene.scene_box.aabb[0] + unit * scene.scene_box.size
    seen = {sensor: np.zeros(len(points), bool) for sensor in used}
    for view in scene.train_indices:
        seen[scene.frames[view].sensor] |= look_up(scene.cameras, view, points)[2].numpy()
    for sensor, own in seen.items():
        others = np.any([seen[other] for other in used if other != sensor], axis=0)
        share = float((own & others).sum() / max(own.sum(), 1))
        if share < _LEAST_OVERLAP:
            name = scene.sensors[sensor].name
            yield Finding.of(Message.SENSORS_APART, sensor=name, share=share, most=_LEAST_OVERLAP)
