"""Regions of a surface that is known exactly: their size, what is in them, what is kept of them and what is refused."""

import json
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh

from tests.factories.ball_model import RADIUS, SHADE, ball_scene, cameras_around
from tests.factories.ball_page import box
from tests.factories.cameras import FRAME
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.run_json import RUN_FORMAT
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.trained import measured_surface
from unmix_plugin.trained.measured_surface import MeasuredSurface
from unmix_plugin.trained.measures import keep_region, read_measures
from unmix_plugin.trained.regions import Box, InView, OfMaterial, check_name, polygon_mask
from unmix_plugin.trained.surface_mesh import TriangleMesh, vertex_areas

SCENE = replace(ball_scene(), frame=FRAME)
WORLD_RADIUS = RADIUS / FRAME.scale
[CAMERA] = cameras_around([(0.3, 0.1, 1.0)])


@pytest.fixture(scope="module")
def surface():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return MeasuredSurface(SCENE, TriangleMesh(np.asarray(ball.vertices), np.asarray(ball.faces)))


def test_a_box_has_its_part_of_a_ball(surface):
    all_of_it = surface.measure(box([-9.0] * 3, [9.0] * 3), "all")
    assert all_of_it.area == pytest.approx(4 * np.pi * WORLD_RADIUS**2, rel=0.01)
    upper, lower = (SHADE * SCENE.materials.endmembers.detach().double().numpy())[:2]
    np.testing.assert_allclose(all_of_it.abundances, [0.5, 0.5, 0], atol=0.03)
    np.testing.assert_allclose(all_of_it.mean, (upper + lower) / 2, atol=0.03)
    np.testing.assert_allclose(all_of_it.spread, np.abs(upper - lower) / 2, atol=0.03)
    cap = surface.measure(box([-9.0, -9.0, WORLD_RADIUS / 2], [9.0] * 3), "cap")
    assert cap.area == pytest.approx(np.pi * WORLD_RADIUS**2, rel=0.02)
    np.testing.assert_allclose(cap.abundances, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(cap.spread, 0, atol=1e-6)


def test_a_rough_sheet_is_as_large_as_the_flat_one_it_stands_for():
    x, y = np.meshgrid(np.arange(61.0), np.arange(61.0))
    height = np.random.default_rng(0).normal(0, 0.4, x.size)
    corner = (np.arange(60)[:, None] * 61 + np.arange(60)).ravel()
    faces = np.concatenate([corner[:, None] + [0, 1, 62], corner[:, None] + [0, 62, 61]])
    sheet = TriangleMesh(np.stack([x.ravel(), y.ravel(), height], axis=1), faces)
    areas = vertex_areas(sheet.areas(), faces, x.size)
    is_right, is_first_row = x.ravel() > 30, np.arange(x.size) < 61
    assert areas[~is_first_row & ~is_right].sum() == pytest.approx(30.5 * 59.5, rel=0.02)
    assert areas[~is_first_row & is_right].sum() == pytest.approx(29.5 * 59.5, rel=0.02)


def test_a_material_is_where_it_prevails(surface):
    half = surface.measure(OfMaterial(0), "upper")
    assert half.area == pytest.approx(2 * np.pi * WORLD_RADIUS**2, rel=0.03)
    assert half.abundances[0] > 0.99
    for number, message in ((2, "has nothing of the surface in it"), (3, "no material 3; it has 3")):
        with pytest.raises(ConfigError, match=message):
            surface.measure(OfMaterial(number), "other")


def test_a_view_marks_what_it_sees_and_not_what_is_behind(surface):
    seen = surface.measure(InView.of_mask(CAMERA, np.ones((40, 40), bool)), "seen")
    # A camera at a distance of 3 sees the cap above radius / 3; the last pixel before the outline is much of its area.
    assert seen.area == pytest.approx(2 * np.pi * WORLD_RADIUS**2 * (1 - RADIUS / 3), rel=0.12)
    middle = [(16.0, 16.0), (24.0, 16.0), (24.0, 24.0), (16.0, 24.0)]
    patch = surface.measure(InView.of_mask(CAMERA, polygon_mask(middle, (40, 40))), "patch")
    pixel = (3 - RADIUS) / float(CAMERA.focal_px[0, 0]) / FRAME.scale
    assert patch.area == pytest.approx((8 * pixel) ** 2, rel=0.05)
    # Finer pixels than the surface is known to lose nothing of it.
    fine, corners = CAMERA.resized(1280, 1280), [(32 * x, 32 * y) for x, y in middle]
    rough = MeasuredSurface(SCENE, TriangleMesh(1.02 * surface.mesh.vertices, surface.mesh.faces))
    same = rough.measure(InView.of_mask(fine, polygon_mask(corners, (1280, 1280))), "same")
    assert same.area == pytest.approx(patch.area, rel=0.05)


def test_a_camera_of_any_size_costs_a_million_rays_at_most(surface, monkeypatch):
    looked, look = [], type(SCENE).look

    def noted(scene, camera, **more):
        looked.append(camera.width * camera.height)
        return look(scene, camera, **more)

    assert measured_surface._MOST_RAYS <= 1 << 20
    monkeypatch.setattr(measured_surface, "_MOST_RAYS", 1 << 14)
    monkeypatch.setattr(type(SCENE), "look", noted)
    seen = surface.measure(InView(CAMERA.resized(2048, 2048), [0, 2048 * 2048]), "seen")
    assert seen.area == pytest.approx(2 * np.pi * WORLD_RADIUS**2 * (1 - RADIUS / 3), rel=0.12)
    assert looked == [1 << 14]


def test_regions_come_back_as_they_were_kept(tmp_path):
    run, mask = RunFolder(tmp_path), np.random.default_rng(0).random((40, 40)) > 0.5
    some = Box((0.0, 1.0, 2.0), (1.0, 2.0, 3.0))
    kept = {"a b": some, "m": OfMaterial(2), "v": InView.of_mask(CAMERA, mask)}
    for name, region in kept.items():
        keep_region(run, name, region)
    found = read_measures(run).regions
    assert (found["a b"], found["m"], list(found)) == (kept["a b"], kept["m"], list(kept))
    view: Any = found["v"]
    np.testing.assert_array_equal(view.mask(), mask)
    keep_region(run, "m", None)
    assert list(read_measures(run).regions) == ["a b", "v"]
    with pytest.raises(ConfigError, match="no region 'm'"):
        keep_region(run, "m", None)


def test_many_regions_of_large_views_take_little_memory_until_they_are_measured(tmp_path):
    large = {"kind": "view", "camera": CAMERA.resized(8192, 8192).to_json(), "runs": [8192**2]}
    regions = {str(number): large for number in range(8)}
    (tmp_path / "measures.json").write_text(json.dumps({"format_version": RUN_FORMAT, "regions": regions}))
    tracemalloc.start()
    read_measures(RunFolder(tmp_path))
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert kept < 1e7


def test_names_that_no_file_can_have_or_that_tables_take_for_formulas_are_refused():
    paths, formulas = ("", " ", "../x", "a/b", ".x", "leaf.", "a\nb", "con", "x" * 65), "=1+1 +x -x @SUM(A1)"
    for name in (*paths, *formulas.split()):
        with pytest.raises(ConfigError, match="can't be the name of a region"):
            check_name(name)
    with pytest.raises(ConfigError, match="'material leaf' can't be the name of a region: exports"):
        check_name("material leaf")
    assert check_name(" e\u0301pave (2) ") == "\u00e9pave (2)"  # however it is composed


def test_names_that_differ_in_capitals_are_refused_since_some_systems_take_their_files_for_one(tmp_path):
    run = RunFolder(tmp_path)
    for material in (0, 1):
        keep_region(run, "Leaf", OfMaterial(material))
    with pytest.raises(ConfigError, match="'leaf' can't be the name of a region: 'Leaf' is one"):
        keep_region(run, "leaf", OfMaterial(0))
    with pytest.raises(ConfigError, match="no region 'leaf'"):
        keep_region(run, "leaf", None)
    assert read_measures(run).regions == {"Leaf": OfMaterial(1)}


@pytest.mark.parametrize(
    "regions",
    [
        [],
        {"../x": {"kind": "material", "material": 0}},
        {"x": {"kind": "sphere"}},
        {name: {"kind": "material", "material": 0} for name in ("x", "X")},
        {"x": {"kind": "material", "material": -1}},
        {"x": {"kind": "box", "low": [0, 0, 0], "high": [1, 1]}},
        {"x": {"kind": "box", "low": [0, 0, 0], "high": [1, 0, 1]}},
        {"x": {"kind": "view", "camera": CAMERA.to_json(), "runs": [10]}},
        {"x": {"kind": "view", "camera": CAMERA.to_json(), "runs": [-1, 1601]}},
        {"x": {"kind": "view", "camera": {}, "runs": [1600]}},
        {str(number): {"kind": "material", "material": 0} for number in range(300)},
    ],
)
def test_damaged_regions_are_refused(regions, tmp_path):
    (tmp_path / "measures.json").write_text(json.dumps({"format_version": RUN_FORMAT, "regions": regions}))
    with pytest.raises(RunError, match=r"measures\.json is damaged"):
        read_measures(RunFolder(tmp_path))
