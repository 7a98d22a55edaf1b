# pyright: reportOptionalMemberAccess=false
"""What was measured at a place: one rule, the same numbers in the viewer, in exports and in Python."""

import csv
import shutil
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from tests.factories.ball_model import RADIUS, ball_scene
from tests.factories.cameras import FRAME
from tests.factories.models import BOX, NUM_BANDS
from unmix_plugin.editing import Light, Recipe, Remove, edit_scene
from unmix_plugin.engine.processes import ALONE
from unmix_plugin.engine.runs.loading import SceneRecord
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.training_control import DeviceLock
from unmix_plugin.products import spectrum as spectrum_product
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Spectrum
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.trained.places import MeasuredScene, Pixel, Point, spectrum_at
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.viewer.panels.probe import take_probe
from unmix_plugin.viewer.rendering.pictures import PictureMaker
from unmix_plugin.viewer.rendering.scene import Edit, MeasuredViews, SceneSource


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "demo"
    make_demo_scene(folder, 24, NUM_BANDS, 12)
    return load_scene(folder)


@pytest.fixture(scope="module")
def trained(scene):
    """A ball, as if it had been trained on the scene."""
    return trained_on(scene)


def trained_on(scene):
    frames: dict[int, Any] = {
        **dict.fromkeys(scene.train_indices, "train"),
        **dict.fromkeys(scene.eval_indices, "eval"),
    }
    views = tuple(
        RunView(scene.frames[index].name, scene.cameras[index], split) for index, split in frames.items()
    )
    return replace(ball_scene(), views=views, frame=FRAME)


@pytest.fixture
def measured(scene, monkeypatch):
    monkeypatch.setattr(type(scene), "alpha", lambda _, __: None)  # its objects are not the ball
    return MeasuredScene(scene, None)


def middle(camera):
    return Pixel(camera, camera.width // 2, camera.height // 2)


def seen_by_hand(scene, trained, position):
    """Views of which a whole render ends within two pixels of a point of the ball, what they measured, and how much
    the surface faces them there."""
    found, facing = {}, {}
    point = torch.from_numpy(position).float()
    for index in scene.train_indices:
        camera = scene.cameras[index]
        coords, depths = camera.project(point[None], 0)
        column, row = coords[0].long().tolist()
        towards = camera.camera_to_world[0, :, 3] - point
        name = scene.frames[index].name
        if depths[0] > 0 and 0 <= column < camera.width and 0 <= row < camera.height:
            facing[name] = float(point @ towards) / float(point.norm() * towards.norm())
            rays, seen = camera.image_rays(0), trained.look(camera, subpixels=1).coefficients
            number = row * camera.width + column
            end = rays.origins[number] + seen.ray_distance[row, column] * rays.directions[number]
            near = float((end - point).norm()) <= 2 * float(depths[0] / camera.focal_px[0].min())
            if near and seen.accumulation[row, column] > 0.5:
                found[name] = scene.cube(index)[row, column]
    return found, facing


def test_the_mean_is_over_the_training_views_that_see_the_place(scene, trained, measured):
    place = middle(scene.cameras[scene.eval_indices[0]])
    found: Any = spectrum_at(trained, place, measured)
    expected, facing = seen_by_hand(scene, trained, found.probe.position)
    assert found.measured.views == tuple(expected)
    assert 2 <= len(expected) < len(scene.train_indices)
    assert {name for name, cosine in facing.items() if cosine > 0.3} <= set(expected)
    assert not {name for name, cosine in facing.items() if cosine < -0.1} & set(expected)
    spectra = np.stack(list(expected.values())).astype(float)
    np.testing.assert_allclose(found.measured.mean, spectra.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found.measured.spread, spectra.std(axis=0, ddof=1), rtol=1e-6)
    world = found.probe.world_position
    same = spectrum_at(trained, Point(*world.tolist()), measured)
    assert same.measured.views == found.measured.views


def test_a_point_inside_was_measured_by_no_view(trained, measured):
    inside = FRAME.to_world(np.array([0.0, 0.0, RADIUS - 0.2]))
    found = spectrum_at(trained, Point(*inside.tolist()), measured)
    assert found.probe.opacity > 0.5
    assert found.measured is None


def test_pixels_that_do_not_count_or_show_two_things_are_left_out(scene, trained, tmp_path, monkeypatch):
    shutil.copytree(scene.root, tmp_path / "holed")
    index = scene.train_indices[1]
    cube = np.load(scene.frames[index].cube_path)
    cube[2:] = np.nan
    np.save(tmp_path / "holed" / scene.frames[index].cube_path.relative_to(scene.root), cube)
    holed = load_scene(tmp_path / "holed", SceneOptions(invalid_pixels="mask"))
    monkeypatch.setattr(type(scene), "alpha", lambda _, __: None)
    place = middle(scene.cameras[index])
    whole = spectrum_at(trained, place, MeasuredScene(scene, None)).measured
    found = spectrum_at(trained, place, MeasuredScene(holed, None)).measured
    name = scene.frames[index].name
    assert name in whole.views
    assert found.views == tuple(one for one in whole.views if one != name)
    half = torch.full((24, 24), 0.9).numpy()
    monkeypatch.setattr(type(scene), "alpha", lambda _, view: half if view == index else None)
    assert spectrum_at(trained, place, MeasuredScene(scene, None)).measured.views == found.views


def test_edits_change_the_light_of_what_was_measured_and_not_who_saw_it(scene, trained, measured):
    place = middle(scene.cameras[scene.eval_indices[0]])
    plain = spectrum_at(trained, place, measured)
    lit = spectrum_at(edit_scene(trained, Recipe((), Light("A"))), place, measured)
    assert lit.measured.views == plain.measured.views
    factors = edit_scene(trained, Recipe((), Light("A"))).light_power
    np.testing.assert_allclose(lit.measured.mean, plain.measured.mean * factors, rtol=1e-5)
    gains = torch.rand(len(scene.train_indices), NUM_BANDS) + 0.5
    exposed = spectrum_at(replace(trained, view_gains=gains), place, measured).measured
    rows = [[scene.frames[i].name for i in scene.train_indices].index(name) for name in exposed.views]
    np.testing.assert_allclose(exposed.spectra, plain.measured.spectra / gains[rows].numpy(), rtol=1e-5)
    # Below what is removed nothing was measured: the ball stood there.
    away = edit_scene(trained, Recipe((Remove((0,)),)))
    below = spectrum_at(away, Point(*FRAME.to_world(np.array([0.0, 0.0, -RADIUS])).tolist()), measured)
    from_above = Pixel(scene.cameras[scene.train_indices[0]], 12, 12)
    behind = spectrum_at(away, from_above, measured)
    assert behind.measured is None or scene.frames[scene.train_indices[0]].name not in behind.measured.views
    assert below.probe.opacity > 0.5


def test_viewer_export_and_python_say_the_same_of_a_place(scene, trained, measured, tmp_path):
    index = scene.eval_indices[0]
    camera, name = scene.cameras[index], scene.frames[index].name
    python = spectrum_at(trained, Pixel(camera, 13, 12), measured)
    cameras = [replace(scene.cameras[i]) for i in scene.train_indices]
    record = SceneRecord(BOX, {}, cameras[0], cameras[1], {})
    turns = DeviceLock()
    source = SceneSource(RunFolder(tmp_path), record, turns, lambda: trained)
    maker = PictureMaker(source)
    maker.aids.measured = MeasuredViews(scene, source)
    taken, turn = [], turns.viewing_turn
    turns.viewing_turn = lambda cost: taken.append(cost) or turn(cost)  # type: ignore[method-assign]
    clicked = take_probe(maker, Edit(), camera, (13.2, 12.9), 1)
    assert len(taken) == 1
    np.testing.assert_array_equal(clicked.measured, python.measured.mean)
    assert clicked.measured_in == f"{len(python.measured.views)} training views, mean"
    loaded: Any = SimpleNamespace(
        materials_scene=trained, scene=trained, record=SimpleNamespace(summary={}), folder=RunFolder(tmp_path)
    )
    quiet = (lambda _: None, lambda _: nullcontext(), lambda _, items: iter(items))
    job = Job(loaded, tmp_path, False, *quiet, ALONE)
    object.__setattr__(job, "measured_scene", lambda _: scene)
    spectrum_product.export(job, Spectrum(view=name, pixel="13,12"))
    with (tmp_path / f"{name}_x13_y12.csv").open() as file:
        rows = list(csv.DictReader(file))
    np.testing.assert_allclose(
        [float(row["mean over views"]) for row in rows], python.measured.mean, rtol=1e-8
    )
    np.testing.assert_allclose(
        [float(row["predicted"]) for row in rows], clicked.predicted, rtol=1e-6, atol=1e-8
    )
