"""From files to a validated scene: transforms.json, cubes, splits, bounds, carving."""

from unmix_plugin.scenes.geometry.carving import carve
from unmix_plugin.scenes.placement import Normalisation
from unmix_plugin.scenes.reading.images import UNLABELLED
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Frame, Scene
from unmix_plugin.settings import SceneOptions

__all__ = ["UNLABELLED", "Frame", "Normalisation", "Scene", "SceneOptions", "carve", "load_scene"]
