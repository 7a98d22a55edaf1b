"""What the views of a capture say of places: their own spectra, and where the surface is."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch

from tests.factories.ball_model import ALL_ROUND, RADIUS, ball_scene, cameras_around
from unmix_plugin.comparing.captured import Capture
from unmix_plugin.trained.places import MeasuredScene
from unmix_plugin.trained.run_views import RunView

SIDES = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.8, 0.0, 0.6], [0.0, 0.6, -0.8]])


@pytest.fixture(scope="module")
def capture() -> Capture:
    """A ball whose views measured what is rendered of it, twice as bright."""
    scene = ball_scene()
    views = tuple(
        RunView(f"view_{index}", camera, "train") for index, camera in enumerate(cameras_around(ALL_ROUND))
    )
    scene = replace(scene, views=views, pixel_size=0.04)
    cubes = [2 * scene.look(view.camera)["spectral"].cpu().numpy() for view in views]
    size = cubes[0].shape[:2]
    measured = MagicMock(spec=MeasuredScene)
    measured.comparable = lambda _index, values, _scene: values.astype(np.float64)
    measured.scene = SimpleNamespace(
        frames=[SimpleNamespace(name=view.name) for view in views],
        sensor_of=lambda _index: SimpleNamespace(sees_all_bands=True),
        cube=lambda index: cubes[index],
        alpha=lambda _index: None,
        valid_mask=lambda _index: np.ones(size, bool),
    )
    return Capture("ball", Path("ball"), scene, measured, None)


def observed(capture: Capture, radius: float) -> Any:
    """Of points of a ball so large, in the world."""
    frame = capture.scene.frame
    return capture.observe(frame.to_world(radius * SIDES), SIDES @ frame.rotation)


def test_views_that_face_a_place_say_what_they_measured(capture):
    found = observed(capture, RADIUS)
    seen = np.isfinite(found.spectra[:, :, 0])
    assert seen.any(axis=0).all()
    assert not seen.all(axis=0).any()  # no place is seen from all sides
    shown = 2 * 0.8 * capture.scene.materials.endmembers.cpu().numpy()
    for place, material in enumerate((0, 1, 0, 1)):
        np.testing.assert_allclose(np.nanmean(found.spectra[:, place], axis=0), shown[material], rtol=0.03)


def test_heights_are_those_of_the_surface_above_a_place(capture):
    pixel = capture.scene.pixel_size
    for depth in (-1.0, 0.0, 1.5):
        found = observed(capture, RADIUS - depth * pixel)
        np.testing.assert_allclose(np.nanmean(found.heights, axis=0), depth, atol=0.25)


def test_where_matter_is_gone_the_surface_is_as_low_as_is_told_apart(capture):
    found = observed(capture, RADIUS + 8 * capture.scene.pixel_size)
    assert np.nanmin(found.heights) == -6.0
    assert np.isnan(found.spectra).all()


def test_the_surface_has_the_area_and_the_materials_of_the_ball(capture):
    surface = capture.surface()
    area = 4 * np.pi * (RADIUS / capture.scene.frame.scale) ** 2
    assert surface.areas.sum() == pytest.approx(area, rel=0.1)
    away = capture.scene.frame.to_model(surface.positions)
    outwards = away / np.linalg.norm(away, axis=1, keepdims=True) @ capture.scene.frame.rotation
    assert (outwards * surface.normals).sum(axis=1).mean() > 0.97
    above = away[:, 2] > 0.1
    assert surface.abundances[above, 0].mean() > 0.95


def test_views_with_fitted_poses_count_only_where_they_were_trained_on(capture):
    views = tuple(replace(view, split="eval") for view in capture.scene.views[:3])
    scene = replace(capture.scene, views=views + capture.scene.views[3:])
    assert len(replace(capture, scene=scene).usable_views) == len(ALL_ROUND)
    fitted = replace(scene, fitted=("pose",))
    assert len(replace(capture, scene=fitted).usable_views) == len(ALL_ROUND) - 3
    assert torch.equal(fitted.views[3].camera.focal_px, capture.scene.views[3].camera.focal_px)
