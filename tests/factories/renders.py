"""Renders of a tiny scene, and their files read back with other people's readers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import spectral.io.envi as envi

from tests.factories.cameras import cameras_at
from tests.factories.models import make_scene
from tests.factories.scenes import ring_poses
from unmix_plugin.products.render.cameras import RenderCameras
from unmix_plugin.products.render.files import FormattedOutput, choose_formats
from unmix_plugin.products.render.job import RenderJob, Survey, take_survey
from unmix_plugin.trained.mixture_view import values_of
from unmix_plugin.trained.run_views import RunView

SCENE = make_scene()


def views(count: int = 2, is_path: bool = False, width: int = 14, height: int = 11) -> RenderCameras:
    """Cameras around the model's box."""
    cameras = cameras_at(ring_poses(count), width, height, focal=24.0)
    named = tuple(RunView(f"view.{index}", cameras[index]) for index in range(count))
    return RenderCameras(named, is_path, None)


def render(
    folder: Path,
    outputs: Sequence[str],
    formats: Sequence[str],
    cameras: RenderCameras,
    pixels: int | None = None,
) -> tuple[tuple[FormattedOutput, ...], Survey, RenderJob]:
    """Render into a folder."""
    products = choose_formats(outputs, formats, SCENE, cameras.is_path)
    survey = take_survey(SCENE, cameras.views, {product.output for product in products})
    job = RenderJob(SCENE, cameras, products, survey, folder)
    job.render(job.blocks(pixels))
    return products, survey, job


def truth(cameras: RenderCameras, index: int, survey: Survey) -> dict[str, np.ndarray]:
    """What the scene itself renders of a view, all at once."""
    names = [product.output.name for product in choose_formats(["all"], [], SCENE, False)]
    asked = [*names, "band:550nm", "false-colour:650,550,450"]
    view = SCENE.look(cameras.views[index].camera)
    return {name: values_of(view, survey.outputs.get(name, SCENE.output(name))).numpy() for name in asked}


def read_envi(base: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Numbers as they are on disk, and the header."""
    image: Any = envi.open(f"{base}.hdr", f"{base}.img")
    return np.array(image.open_memmap()), image.metadata


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """Pixels by channel."""
    file = OpenEXR.File(str(path), separate_channels=True)
    return {name: channel.pixels for name, channel in file.channels().items()}
