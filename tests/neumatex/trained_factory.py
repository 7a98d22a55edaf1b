"""A trained object without a training."""

import numpy as np
import torch

from tests.neumatex.material_export.surfaces import PBR, ball
from tests.viewer.view_factory import BOX, ring
from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.neumatex.geometry.ray_mesh import RayMesh
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.tone.curves import tone_curve
from unmix_plugin.neumatex.trained_object import TrainedObject
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.trained.run_views import recorded_views

CAMERAS = ring()
RECORD = SceneRecord(BOX, {}, CAMERAS, CAMERAS[[1, 3]], {})
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
FRAME = Normalisation(TURN, np.zeros(3), 0.5)


def uneven_light():
    """Bright on the side of +x, dark elsewhere."""
    image = torch.full((8, 16, 3), 0.05)
    image[2:6, 7:9] = 8.0
    return Environment(image)


def make_object(light=None, surface=PBR, **settings):
    torch.manual_seed(0)
    return TrainedObject(
        RayMesh(ball(2).transformed(0.6, torch.zeros(3))),
        surface,
        uneven_light() if light is None else light,
        FRAME,
        recorded_views(RECORD),
        BOX,
        tone_curve("srgb"),
        lambda positions: positions.new_full((len(positions), 5), -4.0),
        samples=16,
        **settings,
    )
