"""The page of a ball that is known exactly, drawn in a browser: regions, known spectra, absorptions, large surfaces."""

import base64
import csv
import gzip
import io
import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
import trimesh

from tests.commands.browser import CHROMIUM, FLAGS, HAS_BROWSER, SOFTWARE_GL
from tests.products.ball_model import ALL_ROUND, RADIUS, SHADE, ball_scene, cameras_around
from tests.trained.camera_scenes import FRAME
from unmix_plugin.editing import Light, Recipe, edit_scene
from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.formats.libraries import library_of
from unmix_plugin.products.page import page
from unmix_plugin.products.product import Job
from unmix_plugin.spectral.features import absorption, continuum_removed
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.trained.measures import Measures, Scale
from unmix_plugin.trained.regions import Box, OfMaterial
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.surface_mesh import vertex_areas

MIDDLE = FRAME.to_world(np.zeros(3))
WORLD_RADIUS = RADIUS / FRAME.scale
SCALE = Scale(0.1, "as measured")
NAMES = ('<img src=x onerror="document.title=1">', "lower & half", "=none")
VIEWS = tuple(
    RunView(f"view {index}", camera, "eval" if index == 0 else "train")
    for index, camera in enumerate(cameras_around([(1.0, 0.2, 0.6), *ALL_ROUND]))
)
SCENE = ball_scene()
SCENE = replace(
    SCENE,
    frame=FRAME,
    scale=SCALE,
    views=VIEWS,
    materials=replace(SCENE.materials, names=NAMES, light=torch.ones(len(SCENE.bands))),
)


def box(low, high):
    """In the world; FRAME keeps the vertical, in which the ball's two materials lie above each other."""
    (a, b, c), (x, y, z) = (MIDDLE + low).tolist(), (MIDDLE + high).tolist()
    return Box((a, b, c), (x, y, z))


REGIONS = {
    "cap <b>": box([-9.0, -9.0, WORLD_RADIUS / 2], [9.0] * 3),
    "below": OfMaterial(1),
    "nowhere": box([8.0] * 3, [9.0] * 3),
    "of no material": OfMaterial(7),
}


def export(folder, scene: Any = SCENE, regions=REGIONS, library=(), resolution=48, edits=None):
    """The facts of a page, what was said while it was made, and its file."""
    said: list[str] = []
    loaded = SimpleNamespace(
        scene=scene,
        materials_scene=scene,
        scale=scene.scale,
        measures=Measures(None, regions),
        scene_name="ball",
        folder=SimpleNamespace(path=Path("ball/unmix-nerf/run")),
        config=SimpleNamespace(method_name="unmix-nerf"),
        record=SimpleNamespace(summary={}),
    )
    job = Job(
        cast("Any", loaded),
        folder,
        True,
        said.append,
        lambda _: nullcontext(),
        lambda _, items: iter(items),
        cast("Any", None),
    )
    (path,) = page.export(job, page.Page(resolution=resolution, library=library, edits=edits))
    facts = json.loads(path.read_text().split('id="data-facts">')[1].split("</script>")[0])
    return facts, said, path


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return export(tmp_path_factory.mktemp("page"))


def test_regions_that_can_not_be_shown_are_said(exported):
    facts, said, _ = exported
    assert facts["regions"] == ["cap <b>", "below"]
    for text in (
        "The region nowhere is left out: the region nowhere has nothing of the surface in it",
        "The region of no material is left out: the scene has no material 7; it has 3.",
    ):
        assert any(one.startswith(text) for one in said)


def test_a_page_of_an_edited_run_says_so(exported, tmp_path):
    facts, said, _ = export(tmp_path, regions={}, edits=Path("aged.yml"))
    note = "Edited: shown with the edits of aged.yml, not as found."
    assert note in facts["notes"]
    assert note in said
    assert not any("Edited" in text for text in exported[0]["notes"])


def test_a_library_is_given_in_full_and_too_large_or_strange_ones_are_refused(tmp_path, monkeypatch):
    bands = SCENE.bands
    own = tmp_path / "own.csv"
    spectra = np.random.default_rng(0).random((3, len(bands)))
    write_spectra_csv(own, SpectraTable(bands, ("a", "b<script>", "c"), spectra))
    facts, _, _ = export(tmp_path, library=(own,))
    assert facts["known"] == [{"name": name, "source": "own.csv"} for name in ("a", "b<script>", "c")]
    with pytest.raises(SpectrumError, match="can't read"):
        export(tmp_path, library=(tmp_path / "none.csv",))
    monkeypatch.setattr(page, "_MOST_KNOWN", 2)
    with pytest.raises(ConfigError, match="the library has 3 spectra; a page has room for 2"):
        export(tmp_path, library=(own,))


def test_a_surface_of_too_many_triangles_is_made_coarser_and_that_is_said(exported, tmp_path, monkeypatch):
    most = round(1.15 * exported[0]["arrays"]["faces"]["count"] / 3)
    monkeypatch.setattr(page, "MOST_TRIANGLES", most)
    facts, said, _ = export(tmp_path, regions={}, resolution=64)
    assert 0.6 * most < facts["arrays"]["faces"]["count"] / 3 <= most
    assert any("triangles is made again with" in text for text in said)


def test_a_page_keeps_both_limits_and_each_surface_is_made_once(exported, tmp_path, monkeypatch):
    tried: list[int] = []
    found = page.find_surface
    monkeypatch.setattr(page, "find_surface", lambda job, cells: tried.append(cells) or found(job, cells))
    most = round(1.15 * exported[0]["arrays"]["faces"]["count"] / 3)
    fixed = 900_000  # bytes of scripts and library
    size = exported[2].stat().st_size
    monkeypatch.setattr(page, "MOST_TRIANGLES", most)
    monkeypatch.setattr(page, "MOST_BYTES", fixed + (size - fixed) // 2)
    facts, said, path = export(tmp_path, resolution=64)
    assert facts["arrays"]["faces"]["count"] / 3 <= most
    assert path.stat().st_size <= page.MOST_BYTES
    assert len(tried) == 3  # as asked, for the triangles, for the bytes
    assert sorted(set(tried), reverse=True) == tried
    again = [text for text in said if "made again with" in text]
    assert [f"{cells} cells" in text for cells, text in zip(tried[1:], again, strict=True)] == [True, True]
    (note,) = [note for note in facts["notes"] if "cells" in note]
    assert f"as fine as {tried[-1]} cells along the longest edge, not 64: browsers turn {most:,}" in note


def test_areas_are_as_good_on_small_triangles_as_on_large_ones():
    areas = np.array([1e-6] * 6 + [1.0])
    positions = np.arange(21.0).reshape(7, 3)
    text, layout = page._packed({"positions": positions, "faces": np.array([[0, 1, 2]]), "areas": areas})
    how = layout["areas"]
    stored = gzip.decompress(base64.b64decode(text))
    found = np.frombuffer(stored, how["type"], how["count"], how["start"])
    np.testing.assert_allclose(found, areas, rtol=1e-3)


def test_a_relit_page_names_the_light_that_it_shows_and_offers_the_recorded_one():
    count = len(SCENE.bands)
    recorded = np.linspace(0.5, 1.0, count)
    light = torch.from_numpy(recorded).float()
    scene = replace(SCENE, materials=replace(SCENE.materials, light=light))
    relit = edit_scene(scene, Recipe(illuminant=Light("A"))).materials
    shown, own, *others = page._spectral_facts(relit, recorded.tolist())["lights"]
    assert (shown["name"], shown["factors"]) == ("A", [1.0] * count)
    assert own["name"] == "the scene's own"
    spectra = relit.endmembers.numpy() * np.array(own["factors"])
    np.testing.assert_allclose(spectra, scene.materials.endmembers.numpy(), rtol=1e-4)
    assert "A" not in [one["name"] for one in others]
    before = page._spectral_facts(scene.materials, recorded.tolist())["lights"]
    assert [one["name"] for one in before[:2]] == ["the scene's own", "D65"]


@pytest.mark.parametrize(("light", "is_assumed"), [(None, False), (torch.ones(len(SCENE.bands)), True)])
def test_a_page_says_that_the_light_is_unknown_though_another_was_lit(light, is_assumed):
    assert page._spectral_facts(SCENE.materials, None)["is_light_known"]
    unknown = replace(SCENE.materials, light=light, is_light_assumed=is_assumed)
    assert not page._spectral_facts(unknown, None)["is_light_known"]


def test_bands_that_the_light_leaves_dark_are_those_of_the_package():
    light = torch.ones(len(SCENE.bands))
    light[2] = 1e-4
    lit = replace(SCENE.materials, light=light)
    assert (
        page._spectral_facts(lit, None)["is_lit"]
        == lit.is_lit.tolist()
        == [band != 2 for band in range(len(light))]
    )


@pytest.fixture(scope="module")
def browser():
    if not HAS_BROWSER:
        pytest.skip("needs the package playwright and the program chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as session:
        found = session.chromium.launch(executable_path=CHROMIUM, args=[FLAGS[1], *SOFTWARE_GL])
        yield found
        found.close()


@pytest.fixture
def opened(exported, browser):
    context = browser.new_context(viewport={"width": 900, "height": 600}, offline=True)
    shown, said = context.new_page(), []
    shown.on("console", lambda message: said.append(message.text))
    shown.on("pageerror", lambda error: said.append(str(error)))
    shown.goto(exported[2].as_uri())
    shown.wait_for_function("window.unmixPage")
    yield shown
    assert said == []
    context.close()


def probes(opened, *names):
    """Numbers of the probes of the page."""
    fields = ", ".join(names)
    return opened.evaluate(
        f"unmixPage.probes.map(({{ name, {fields} }}) => ({{ name, {fields} }}))".replace(", }", " }")
    )


def stroke(opened, corners):
    """Draw around a part of the picture with the mouse."""
    opened.keyboard.press("d")
    opened.mouse.move(*corners[0])
    opened.mouse.down()
    for corner in [*corners[1:], corners[0]]:
        opened.mouse.move(*corner, steps=8)
    opened.mouse.up()


@pytest.mark.slow
def test_kept_regions_are_shown_by_name_with_area_mean_spread_and_mixture(opened):
    assert opened.locator(".probe input[type=text]").evaluate_all("all => all.map((one) => one.value)") == [
        "below",
        "cap <b>",
    ]
    cap, below = probes(opened, "area", "spectrum", "spread", "mixture")
    assert cap["area"] == pytest.approx(np.pi * WORLD_RADIUS**2, rel=0.03)
    assert below["area"] == pytest.approx(2 * np.pi * WORLD_RADIUS**2, rel=0.04)
    upper = SHADE * SCENE.materials.endmembers[0].detach().double().numpy()
    np.testing.assert_allclose(cap["spectrum"], upper, rtol=0.01)
    np.testing.assert_allclose(cap["mixture"], [1, 0, 0], atol=0.01)
    assert max(cap["spread"]) < 0.02 * upper.max()
    assert opened.title() == "ball"
    assert "cap <b>" in opened.inner_text("#labels")


@pytest.mark.slow
def test_a_band_is_reflectance_only_in_a_light_of_1(opened):
    opened.evaluate("unmixPage.choose('band')")
    for light, quantity in (("D65", "radiance"), ("the scene's own", "reflectance")):
        opened.select_option("#light", label=light)
        opened.wait_for_function(f"document.getElementById('about').textContent.startsWith('{quantity} at')")


@pytest.mark.slow
def test_a_region_is_what_is_seen_inside_an_outline_and_is_saved(opened):
    opened.evaluate("(unmixPage.wholeObject(), unmixPage.draw())")
    everything = [(2, 2), (560, 2), (560, 598), (2, 598)]
    stroke(opened, everything)
    (*_, seen) = probes(opened, "area", "mixture")
    # From three radii away one sees a little less than the half that faces the eye.
    distance = opened.evaluate("1.06 / Math.sin(20 * Math.PI / 180)")
    assert seen["area"] == pytest.approx(2 * np.pi * WORLD_RADIUS**2 * (1 - 1 / distance), rel=0.08)
    opened.locator(".probe input[type=text]").first.fill('my "part", 1')
    opened.locator(".probe input[type=text]").first.press("Enter")
    table = list(csv.reader(io.StringIO(opened.evaluate("unmixPage.csvText()"))))
    assert table[0] == ["quantity", "cap <b>", "below", 'my "part", 1']
    rows = {row[0]: row[1:] for row in table}
    assert len(rows) == len(table)
    assert float(rows["area in cm2"][2]) == pytest.approx(seen["area"] * 1e4 * 0.1**2)
    assert float(rows[f"abundance of {NAMES[1]}"][2]) == pytest.approx(seen["mixture"][1])
    assert len([name for name in rows if name.startswith("standard deviation at")]) == len(SCENE.bands)
    assert "cm²" in opened.inner_text("#probes")
    opened.keyboard.press("d")
    assert opened.inner_text("#hint") == "Draw around a part of the object."
    opened.keyboard.press("d")
    stroke(opened, [(3, 3), (12, 3), (12, 12)])
    assert "Nothing of the surface is inside" in opened.inner_text("#hint")


@pytest.mark.slow
def test_a_click_is_compared_with_the_library_as_the_viewer_compares(opened):
    opened.evaluate("(unmixPage.wholeObject(), unmixPage.draw())")
    opened.mouse.click(285, 300)
    (*_, point) = probes(opened, "spectrum", "likeness")
    expected = library_of(()).nearest(np.array([point["spectrum"]]), SCENE.bands, np.ones(len(SCENE.bands)))
    assert [match["name"] for match in point["likeness"]] == [match.name for match in expected[0]]
    np.testing.assert_allclose(
        [match["angle"] for match in point["likeness"]], [match.angle_rad for match in expected[0]], atol=1e-3
    )
    text = opened.inner_text("#probes")
    assert f"like {expected[0][0].name} ({expected[0][0].angle_rad:.3f} rad" in text
    assert opened.locator("#chart polyline[stroke-dasharray]").count() == 3


@pytest.mark.slow
def test_features_are_those_of_the_package(opened):
    rng = np.random.default_rng(1)
    for count in (3, 5, 40, 300):
        nm = np.sort(rng.uniform(400, 2500, count))
        spectra = rng.random((20, count)) * rng.random((20, 1)) + 0.05
        spectra[0] = 0.3  # no absorption
        spectra[1, count // 2] = 0.0
        found = opened.evaluate(
            "([spectra, nm]) => spectra.map((one) =>"
            "({ ...Spectra.absorption(one, nm), removed: Spectra.continuumRemoved(one, nm) }))",
            [spectra.tolist(), nm.tolist()],
        )
        values = torch.from_numpy(spectra)
        np.testing.assert_allclose(
            [one["removed"] for one in found], continuum_removed(values, nm), atol=1e-9
        )
        for measure in ("depth", "centre", "area"):
            numbers = np.array([one[measure] for one in found], dtype=np.float64)
            np.testing.assert_allclose(numbers, absorption(values, nm, measure), atol=1e-6)


@pytest.mark.slow
def test_the_continuum_of_a_window_and_its_absorption_are_a_choice(opened):
    opened.select_option("#curve", "continuum removed")
    opened.fill("#low", "480")
    opened.fill("#high", "620")
    opened.press("#high", "Enter")
    (cap, _) = probes(opened, "spectrum")
    inside = np.array(cap["spectrum"])[1:4]
    nm = SCENE.bands.centers_nm[1:4]
    depth = float(absorption(torch.from_numpy(inside), nm, "depth"))
    assert f"absorption: depth {depth:.3g}"[:22] in opened.inner_text("#probes")
    rows = list(csv.reader(io.StringIO(opened.evaluate("unmixPage.csvText()"))))
    saved = {row[0]: row[1:] for row in rows}["depth of the absorption from 500 to 600 nm"]
    assert float(saved[0]) == pytest.approx(depth, abs=1e-6)


LOOK_AWAY = """() => {
  const { cameras } = unmixPage.facts;
  const away = { ...cameras[0], axes: cameras[0].axes.map((axis, i) => axis.map((part) => (i === 1 ? part : -part))) };
  unmixPage.lookThrough(cameras.push(away) - 1);
  unmixPage.draw();
}"""


@pytest.mark.slow
def test_names_are_text_in_a_table_and_one_is_changed_after_the_other(opened):
    opened.evaluate("(unmixPage.wholeObject(), unmixPage.draw())")
    for place in ((285, 300), (285, 340)):
        opened.mouse.click(*place)
    for row, name in ((1, "=1+1"), (0, "@second")):
        opened.locator(".probe input[type=text]").nth(row).click()
        opened.keyboard.press("Control+a")
        opened.keyboard.type(name)
    opened.keyboard.press("Enter")
    table = list(csv.reader(io.StringIO(opened.evaluate("unmixPage.csvText()"))))
    assert table[0][-2:] == ["_=1+1", "_@second"]
    opened.evaluate("unmixPage.draw()")
    assert "=1+1" in opened.inner_text("#labels")
    opened.evaluate(LOOK_AWAY)  # what lies behind the eye is in no region and has no label
    assert not opened.locator("#labels span:not([hidden])").count()
    stroke(opened, [(2, 2), (560, 2), (560, 598), (2, 598)])
    assert "Nothing of the surface is inside" in opened.inner_text("#hint")


def shape_in_colour(shape, away):
    """What a page shows of triangles without bands, that are looked at from `away`."""
    positions = FRAME.to_world(np.array(shape.vertices))
    areas = trimesh.triangles.area(positions[shape.faces])
    content = page.PageContent(
        {
            "positions": positions,
            "faces": np.array(shape.faces),
            "areas": vertex_areas(areas, shape.faces, len(positions)),
        },
        {"lights": [{"name": "white", "factors": [], "notes": []}], "notes": [], "colour": "grey"},
        {},
    )
    (camera,) = cameras_around([away])
    views = (RunView("from there", camera, "train"),)
    return SimpleNamespace(page_content=lambda _: content, views=views, frame=FRAME, scale=SCALE)


def plate():
    """A square much thinner than its triangles are long."""
    return trimesh.creation.box((1.0, 1.0, 0.02)).subdivide_to_size(0.1)


def sheet():
    """The upper side of a square."""
    shape: Any = plate()
    shape.update_faces(shape.face_normals[:, 2] > 0.5)
    shape.remove_unreferenced_vertices()
    return shape


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "away"),
    [(plate(), (0.3, 0.2, 1.0)), (sheet(), (0.3, 0.2, 1.0)), (sheet(), (0.3, 0.2, -1.0))],
    ids=["plate", "sheet", "sheet from its back"],
)
def test_one_side_of_something_thin_is_seen(shape, away, browser, tmp_path):
    _, _, path = export(tmp_path, shape_in_colour(shape, away), {})
    opened = browser.new_page(viewport={"width": 900, "height": 600})
    opened.goto(path.as_uri())
    opened.wait_for_function("window.unmixPage")
    stroke(opened, [(2, 2), (560, 2), (560, 598), (2, 598)])
    (seen,) = probes(opened, "area")
    opened.close()
    assert seen["area"] == pytest.approx(1 / FRAME.scale**2, rel=0.08)


def test_a_page_that_can_not_be_small_enough_is_said_to_be_large(tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MOST_BYTES", 1000)
    _, said, path = export(tmp_path, regions={})
    assert f"the page has {path.stat().st_size / 1e6:.1f} MB, more than a mail takes" in said
