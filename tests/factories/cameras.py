"""Run records with cameras around, before, or inside a scene."""

from __future__ import annotations

import numpy as np
import torch

from tests.factories.scenes import cameras_of, look_at, ring_poses
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.runs.loading import SceneRecord
from unmix_plugin.scenes.scene import Normalisation

BOX = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FRAME = Normalisation(_QUARTER, np.array([0.3, -2.0, 5.0]), 0.25)
"""From world to model space of these runs."""


def cameras_at(poses: list[np.ndarray], width: int = 40, height: int = 30, focal: float = 50.0) -> Cameras:
    return cameras_of(poses, width, height, focal)


def around(count: int = 12) -> Cameras:
    """Cameras on a ring about the origin, z up."""
    return cameras_at(ring_poses(count))


def in_front(count: int = 9) -> Cameras:
    """Cameras side by side that look at the origin from one side only."""
    places = np.linspace(-0.7, 0.7, count)
    return cameras_at([look_at(np.array([x, -3.0, 0.2]), np.zeros(3)) for x in places])


def record(train: Cameras, evaluation: Cameras) -> SceneRecord:
    """What a run keeps of such a scene."""
    names = [f"view_{index}" for index in range(len(train) + len(evaluation))]
    summary = {
        "frames": names,
        "train_indices": list(range(len(train))),
        "eval_indices": list(range(len(train), len(names))),
        "normalisation": FRAME.to_json(),
    }
    return SceneRecord(BOX, {}, train, evaluation, summary)
