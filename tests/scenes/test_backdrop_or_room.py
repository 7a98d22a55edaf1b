"""Closed rooms with plain walls are rooms; things before a plain backdrop, a wall or a corner stand before it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.factories.demo_parts import one_ray_a_pixel
from tests.factories.files import present
from unmix_plugin.engine.geometry.camera_paths import upright_cameras
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.scenes.backdrop_trial import measure_distance
from unmix_plugin.scenes.backdrops import find_before_backdrop
from unmix_plugin.scenes.demo.scene import Place, demo_cameras, make_demo_scene
from unmix_plugin.scenes.demo.shading import MATERIALS, THINGS, Surface, Thing, plain
from unmix_plugin.scenes.demo.shapes import PlacedPrimitive
from unmix_plugin.scenes.geometry.view_agreement import training_views
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene

SIZE, VIEWS = 48, 20
FLOOR, CEILING = -0.12, 5.0


Place3 = tuple[float, float, float]


def slab(center: Place3, half: Place3, material: str, turn_deg: float = 0.0) -> Thing:
    x, y, z = (float(place) for place in center)
    across, along, high = (float(size) for size in half)
    placement = PlacedPrimitive("box", (x, y, z), (across, along, high), turn_deg=turn_deg)
    return Thing(placement, Surface(material, material, plain))


def room(reach: float, flat: str, left: str, right: str, ends: str) -> list[Thing]:
    """Floor and ceiling, the walls to the sides, and those before and behind."""
    middle, half = 0.5 * (CEILING + FLOOR), 0.5 * (CEILING - FLOOR)
    wide, away = reach + 0.2, reach + 0.1
    return [
        slab((0, 0, FLOOR - 0.1), (wide, wide, 0.1), flat),
        slab((0, 0, CEILING + 0.1), (wide, wide, 0.1), flat),
        slab((-away, 0, middle), (0.1, reach, half), left),
        slab((away, 0, middle), (0.1, reach, half), right),
        slab((0, away, middle), (reach, 0.1, half), ends),
        slab((0, -away, middle), (reach, 0.1, half), ends),
    ]


def corner(away: float, floor: str, left: str, right: str) -> list[Thing]:
    """A floor and two walls that meet behind the table."""
    things, half = [slab((0, 0, FLOOR - 0.1), (12, 12, 0.1), floor)], (away + 6.2) / 2
    for side, material in ((-1, left), (1, right)):
        across, along = np.array([side, 1]) / np.sqrt(2), np.array([-side, 1]) / np.sqrt(2)
        x, y = across * (away + 0.1) + along * (away - 5.8) / 2
        turn_deg = float(np.degrees(np.arctan2(across[1], across[0])))
        things.append(slab((x, y, 3 + FLOOR), (0.1, half, 3), material, turn_deg))
    return things


def around_inside(size: int, views: int) -> Cameras:
    """A ring of wide views from within the walls."""
    angles = np.arange(views) * 2 * np.pi / views
    places = np.stack([2.9 * np.cos(angles), 2.9 * np.sin(angles), 1 + 0.4 * np.sin(3 * angles)], axis=1)
    backward = places - np.array([0, 0, 0.3])
    return upright_cameras(places, backward / np.linalg.norm(backward, axis=1, keepdims=True), size, 1.05)


def before_a_wall(size: int, views: int) -> Cameras:
    """From one side, at heights of 12 to 40 degrees."""
    generator = np.random.default_rng(5)
    azimuth = np.deg2rad(-90 + generator.uniform(-40, 40, views))
    height = np.deg2rad(generator.uniform(12, 40, views))
    flat = np.cos(height)
    backward = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)], axis=1)
    return upright_cameras(np.array([0, 0, 0.22]) + 4.1 * backward, backward, size, np.deg2rad(40))


def wide_dome(size: int, views: int) -> Cameras:
    return demo_cameras(size, views, 60.0)


def sky_of(material: str, level: float) -> Callable[[np.ndarray], np.ndarray]:
    power = level * (np.array(MATERIALS) == material).astype(np.float32)
    return lambda directions: np.tile(power, (len(directions), 1))


def scene_of(folder: Path, *, walls: Sequence[Thing], cameras: Any, sky: Any = None) -> Scene:
    with one_ray_a_pixel():
        place = Place((*THINGS, *walls), cameras, sky or sky_of("white", 0.0))
        make_demo_scene(folder / "scene", SIZE, 5, VIEWS, place=place)
    return load_scene(folder / "scene")


ROOMS = {
    "white": (room(3.6, "white", "white", "white", "white"), around_inside),
    "cyan": (room(3.6, "cyan", "cyan", "cyan", "cyan"), around_inside),
    "white between red walls": (room(4.6, "white", "red", "red", "red"), wide_dome),
    "white, from above": (room(4.4, "white", "white", "white", "white"), demo_cameras),
    "cyan, from above": (room(4.4, "cyan", "cyan", "cyan", "cyan"), demo_cameras),
    "with coloured sides": (room(3.6, "white", "red", "green", "white"), around_inside),
}


@pytest.fixture(scope="module")
def room_named(tmp_path_factory) -> Callable[[str], Scene]:
    """Each room, made once."""

    @lru_cache
    def made(name: str) -> Scene:
        walls, cameras = ROOMS[name]
        return scene_of(tmp_path_factory.mktemp("room"), walls=walls, cameras=cameras)

    return made


@pytest.mark.parametrize("name", ROOMS)
def test_plain_walls_of_a_closed_room_are_no_backdrop(room_named, name):
    scene = room_named(name)
    assert not scene.has_backdrop
    assert any(one.subject == "backdrop" and one.outcome == "none" for one in scene.decisions)


@pytest.mark.parametrize("name", ["white", "white between red walls"])
def test_what_looks_like_a_backdrop_is_tried_against_its_masks(room_named, name):
    scene = room_named(name)
    assert find_before_backdrop(training_views(scene)) is not None  # by looks alone it is one
    [decision] = [one for one in scene.decisions if one.subject == "backdrop"]
    assert decision.outcome == "none"
    assert float(decision.evidence["contradicted"]) > 0.02
    assert present(
        scene.world_reason
    )  # what the views show behind the box decides, as without anything plain


@pytest.mark.parametrize("name", ["white, from above", "cyan, from above"])
def test_a_room_whose_masks_agree_is_told_by_the_distance_of_its_walls(room_named, name):
    views = training_views(room_named(name))
    before = present(find_before_backdrop(views))
    distance = measure_distance(views, before)
    assert distance.far > 0.5  # neither directions nor pixels tell what a view shows
    assert distance.is_near


def test_a_black_backdrop_differs_by_noise_alone(tmp_path):
    folder = tmp_path / "scene"
    scene_of(tmp_path, walls=[], cameras=demo_cameras, sky=sky_of("white", 0.0))
    generator = np.random.default_rng(0)
    for path in sorted((folder / "cubes").glob("*.npy")):
        cube = np.load(path)
        np.save(path, np.abs(cube + generator.normal(0.0, 0.002, cube.shape)).astype(np.float16))
    [decision] = [one for one in load_scene(folder).decisions if one.subject == "backdrop"]
    assert decision.outcome == "found"
    assert float(decision.evidence["differs along directions and in pixels"]) < 0.02


STANDING = {
    "a red wall": [corner(1, *["white"] * 3)[0], slab((0, 2.1, 3), (12, 0.1, 3.2), "red")],
    "a grey corner": corner(1.6, "white", "white", "white"),
    "a corner of three colours": corner(1.6, "white", "cyan", "red"),
}


@pytest.mark.parametrize("name", STANDING)
def test_walls_behind_things_are_part_of_the_scene(tmp_path, name):
    scene = scene_of(tmp_path, walls=STANDING[name], cameras=before_a_wall)
    assert find_before_backdrop(training_views(scene)) is not None  # by looks alone it is one
    assert not scene.has_backdrop
    [decision] = [one for one in scene.decisions if one.subject == "backdrop"]
    assert decision.outcome == "none"
    assert scene.is_unbounded  # a box would cut the walls off


def test_where_views_agree_on_no_place_of_a_backdrop_all_is_kept_and_said(tmp_path):
    """Of a grey sky that some views show brighter."""
    folder = tmp_path / "scene"
    scene_of(tmp_path, walls=[], cameras=demo_cameras, sky=sky_of("white", 0.3))
    for number, path in enumerate(sorted((folder / "cubes").glob("*.npy"))):
        np.save(path, (np.load(path) * (1.0 - 0.05 * (number % 5))).astype(np.float16))
    scene = load_scene(folder)
    [decision] = [one for one in scene.decisions if one.subject == "backdrop"]
    assert decision.is_undecided
    assert not scene.has_backdrop
    assert any("it is kept as part of the scene" in warning for warning in scene.warnings)


BEFORE = {
    "black": ([], demo_cameras, sky_of("white", 0.0)),
    "cyan": ([], demo_cameras, sky_of("cyan", 0.6)),
}


@pytest.mark.parametrize("name", BEFORE)
def test_things_before_plain_walls_stand_before_them(tmp_path, name):
    walls, cameras, sky = BEFORE[name]
    scene = scene_of(tmp_path, walls=walls, cameras=cameras, sky=sky)
    before = present(scene.before_backdrop)
    matter = np.stack(before.masks())
    at_sides = np.concatenate([matter[:, :24, :3].ravel(), matter[:, :24, -3:].ravel()])
    assert at_sides.mean() < 0.1  # nothing of a wall is left, not of one of two either
    assert matter[:, 20:34, 16:32].mean() > 0.8
    [decision] = [one for one in scene.decisions if one.subject == "backdrop"]
    assert decision.outcome == "found"
    assert float(decision.evidence["contradicted"]) <= 0.02
