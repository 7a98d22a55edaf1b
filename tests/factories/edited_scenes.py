"""A tiny scene to edit, and the camera that looks at it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tests.factories.cameras import cameras_at
from tests.factories.models import make_model, scene_of
from unmix_plugin.editing import Recipe, edit_scene, recipe_from_yaml
from unmix_plugin.field import UnmixField
from unmix_plugin.spectral.materials import Coefficients
from unmix_plugin.trained.trained_scene import TrainedScene

LIGHT = [0.5, 0.7, 1.0, 0.9, 0.6]

POSES = [np.eye(4), np.array([[0.0, 0, 1, 4.0], [0, 1, 0, 0.3], [-1, 0, 0, 0], [0, 0, 0, 1]])]
POSES[0][:3, 3] = 0.2, 0.0, 4.0
CAMERAS = cameras_at(POSES, 12, 10, 20.0)
"""Two views of the box, from the front and from the side."""

OUTPUTS = ("spectral", "diffuse", "specular", "abundances", "accumulation", "rgb")


def lit_scene(**settings) -> TrainedScene:
    """Three materials in a light that is not flat, with some gloss."""
    model = make_model(light=LIGHT, **settings)
    assert isinstance(model.field, UnmixField)
    with torch.no_grad():
        for weights in model.field.material_network.parameters():
            weights.mul_(6)  # otherwise every point is about a third of each
    model.field.log_initial_density += 1.5
    return scene_of(model, CAMERAS)


def edited(
    scene: TrainedScene, *edits: str, seen: Coefficients | None = None, light: str = ""
) -> TrainedScene:
    """The scene after edits, each written as in a recipe."""
    made = recipe(*edits, light=light)
    return edit_scene(scene, made) if seen is None else edit_scene(scene, made, lambda _: seen)


def recipe(*edits: str, light: str = "") -> Recipe:
    """A recipe of edits, each written as in a file."""
    lines = [f"illuminant: {light}"] if light else []
    lines += ["edits:", *(f"- {edit}" for edit in edits)] if edits else []
    return recipe_from_yaml("\n".join(lines), "edits.yml")


def rendered(scene: TrainedScene, view: int = 0) -> dict[str, Tensor]:
    """What a camera sees."""
    return scene.render(CAMERAS[view], OUTPUTS)


def tensors_of(scene: TrainedScene) -> dict[str, Tensor]:
    """All that a scene renders from."""
    materials, renderer = scene.materials, scene.renderer
    assert materials.light is not None
    return {
        **scene.field.state_dict(),
        "endmembers": materials.endmembers,
        "specular_spectra": materials.specular_spectra,
        "light": materials.light,
        "skips": renderer.skips,
    }
