"""The page of a ball in a real browser: layers against renders, regions, probes, absorptions, layout."""

import base64
import csv
import io
import itertools
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from scipy.ndimage import binary_erosion
from skimage.color import deltaE_ciede2000, rgb2lab

from tests.factories.ball_model import SHADE, ball_scene, cameras_around
from tests.factories.ball_page import NAMES, SCALE, SCENE, TITLE, WORLD_RADIUS, export
from tests.factories.cameras import FRAME
from tests.factories.commands import CHROMIUM, FLAGS, NEEDS_BROWSER, SOFTWARE_GL
from unmix_plugin.formats.libraries import library_of
from unmix_plugin.products.page import page
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.features import absorption, continuum_removed
from unmix_plugin.trained.run_views import RunView
from unmix_plugin.trained.surface_mesh import vertex_areas

pytestmark = [pytest.mark.slow, NEEDS_BROWSER]
SIDE = 256
EVERYTHING = [(2, 2), (560, 2), (560, 598), (2, 598)]


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return export(tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as session:
        found = session.chromium.launch(executable_path=CHROMIUM, args=[FLAGS[1], *SOFTWARE_GL])
        yield found
        found.close()


@contextmanager
def looking(browser, path, width=900, height=600):
    """A page from its file, without a network, in a window of a size."""
    context = browser.new_context(viewport={"width": width, "height": height}, offline=True)
    shown, said = context.new_page(), []
    shown.on("console", lambda message: said.append(message.text))
    shown.on("pageerror", lambda error: said.append(str(error)))
    shown.on("request", lambda asked: said.append(asked.url))
    shown.goto(path.as_uri())
    shown.wait_for_function("window.unmixPage")
    yield shown
    assert [text for text in said if not text.startswith(("file:", "blob:", "data:"))] == []
    context.close()


@pytest.fixture
def opened(exported, browser, request):
    with looking(browser, exported[2], *getattr(request, "param", ())) as shown:
        yield shown


def drawn(opened):
    """What the canvas shows, sRGB in [0, 1]."""
    url = opened.evaluate("(unmixPage.draw(), document.querySelector('canvas').toDataURL())")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")) / 255


def is_object(opened):
    """Pixels of the canvas that differ from its ground."""
    pixels = drawn(opened)
    return np.abs(pixels - pixels[2, 2]).max(axis=2) > 0.05


def test_layers_match_renders_of_the_same_camera_and_differ(browser, tmp_path):
    glossy = ball_scene(gloss=0.3)
    scene = replace(SCENE, field=glossy.field, materials=replace(glossy.materials, names=NAMES))
    with looking(browser, export(tmp_path, scene, {})[2], SIDE, SIDE) as opened:
        assert_layers_match_and_differ(scene, opened)


def assert_layers_match_and_differ(scene, opened):
    view = scene.views[-1]
    camera = f"unmixPage.facts.cameras.findIndex((one) => one.name === '{view.name}')"
    opened.evaluate(f"unmixPage.lookThrough({camera})")
    rendered = scene.look(view.camera.resized(SIDE, SIDE))
    plain = SCENE.look(view.camera.resized(SIDE, SIDE))["rgb"]
    assert (rendered["rgb"] - plain).abs().max() > 0.1  # which gloss adds
    inside = binary_erosion(rendered.opacity.numpy() > 0.97, iterations=4)
    band = rendered[f"band:{SCENE.bands.centers_nm[len(SCENE.bands) // 2]}nm"].numpy()
    grey = np.where(band <= 0.0031308, 12.92 * band, 1.055 * band.clip(1e-9) ** (1 / 2.4) - 0.055)
    expected = {"colour": rendered["rgb"].numpy(), "band": np.repeat(grey[..., None], 3, axis=-1)}
    opened.evaluate("unmixPage.state.formula = 'r650/r550'")
    shown = {}
    for layer in opened.evaluate("[...document.querySelectorAll('#layer option')].map((one) => one.value)"):
        opened.evaluate(f"unmixPage.choose('{layer}')")
        shown[layer] = drawn(opened)
    assert len(shown) == 7
    for layer, truth in expected.items():
        off = deltaE_ciede2000(rgb2lab(truth), rgb2lab(shown[layer]))[inside]
        assert np.median(off) < 3, (layer, np.median(off))
    for one, other in itertools.combinations(shown, 2):
        assert np.abs(shown[one] - shown[other]).mean() > 0.004, (one, other)
    assert (opened.inner_text("#head h1"), opened.title()) == (TITLE, TITLE)
    opened.evaluate("(unmixPage.state.formula = 'r650 +', unmixPage.choose('index'))")
    assert "the formula ends too early" in opened.inner_text("#about")


def test_colours_that_no_eye_sees_are_not_called_true(browser, tmp_path):
    infrared = replace(SCENE.materials, bands=Bands.of(SCENE.bands.centers_nm + 500))
    _, _, path = export(tmp_path, replace(SCENE, materials=infrared), regions={})
    with looking(browser, path) as shown:
        assert "false colour of all bands" in shown.locator("#layer").inner_text()
        assert "true colour" not in shown.locator("#layer").inner_text()


def test_the_legend_of_materials_has_their_areas(opened):
    opened.evaluate("unmixPage.choose('materials')")
    areas = opened.evaluate("unmixPage.materialAreas")
    keys = opened.locator("#legend .key").all_inner_texts()
    found = [float(text.rsplit(": ", 1)[1].split()[0]) for text in keys]
    assert found == pytest.approx([1e4 * 0.1**2 * area for area in areas if area > 0], rel=1e-2)


@pytest.mark.parametrize("opened", [(1440, 900), (390, 844)], indirect=True)
@pytest.mark.parametrize("folded", [True, False])
def test_the_object_is_not_under_the_panel(opened, folded):
    opened.evaluate(f"document.querySelector('#panel.folded') ? {int(folded)} || unmixPage.fold() : 0")
    opened.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    opened.evaluate("unmixPage.wholeObject()")
    opened.wait_for_timeout(300)
    box, size = opened.locator("#panel").bounding_box(), opened.viewport_size
    columns, rows = np.nonzero(is_object(opened).T)
    is_phone = size["width"] <= 700
    assert 0 < columns.min() < columns.max() < (size["width"] if is_phone else box["x"])
    assert 0 < rows.min() < rows.max() < (box["y"] if is_phone else size["height"])
    assert opened.evaluate("document.documentElement.scrollWidth") <= size["width"]


def test_nothing_is_cut_off_however_far_one_goes_away(opened):
    turn = "document.querySelector('canvas').dispatchEvent(new WheelEvent('wheel', { deltaY: 400 }))"
    counts = [is_object(opened).sum()]
    for _ in range(3):
        opened.evaluate(f"for (let i = 0; i < 6; i++) {turn}")
        counts.append(is_object(opened).sum())
    assert all(after < before for before, after in itertools.pairwise(counts))
    assert counts[-1] > 8


def probes(opened, *names):
    """Numbers of the probes of the page."""
    fields = ", ".join(names)
    return opened.evaluate(f"unmixPage.probes.map(({{ {fields} }}) => ({{ {fields} }}))")


def stroke(opened, corners):
    """Draw around a part of the picture with the mouse."""
    opened.keyboard.press("d")
    opened.mouse.move(*corners[0])
    opened.mouse.down()
    for corner in [*corners[1:], corners[0]]:
        opened.mouse.move(*corner, steps=8)
    opened.mouse.up()


def test_kept_regions_are_shown_by_name_with_area_mean_spread_and_mixture(opened):
    names = opened.locator(".probe input[type=text]")
    assert names.evaluate_all("all => all.map((one) => one.value)") == ["below", "cap <b>"]
    cap, below = probes(opened, "area", "spectrum", "spread", "mixture")
    assert cap["area"] == pytest.approx(np.pi * WORLD_RADIUS**2, rel=0.03)
    assert below["area"] == pytest.approx(2 * np.pi * WORLD_RADIUS**2, rel=0.04)
    upper = SHADE * SCENE.materials.endmembers[0].detach().double().numpy()
    np.testing.assert_allclose(cap["spectrum"], upper, rtol=0.01)
    np.testing.assert_allclose(cap["mixture"], [1, 0, 0], atol=0.01)
    assert max(cap["spread"]) < 0.02 * upper.max()
    assert "cap <b>" in opened.inner_text("#labels")


def test_a_band_is_reflectance_only_in_a_light_of_1(opened):
    opened.evaluate("unmixPage.choose('band')")
    for light, quantity in (("D65: noon daylight, 6504 K", "radiance"), ("the scene's own", "reflectance")):
        opened.select_option("#light", label=light)
        opened.locator("#about", has_text=f"{quantity} at").wait_for()


def test_a_region_is_what_is_seen_inside_an_outline_and_is_saved(opened):
    opened.evaluate("(unmixPage.wholeObject(), unmixPage.draw())")
    stroke(opened, EVERYTHING)
    (*_, seen) = probes(opened, "area", "mixture")
    # From three radii away one sees a little less than the half that faces the eye.
    distance = opened.evaluate("1.06 / Math.sin(20 * Math.PI / 180)")
    assert seen["area"] == pytest.approx(2 * np.pi * WORLD_RADIUS**2 * (1 - 1 / distance), rel=0.1)
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
        removed = [one["removed"] for one in found]
        np.testing.assert_allclose(removed, continuum_removed(values, nm), atol=1e-9)
        for measure in ("depth", "centre", "area"):
            numbers = np.array([one[measure] for one in found], dtype=np.float64)
            np.testing.assert_allclose(numbers, absorption(values, nm, measure), atol=1e-6)


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
    stroke(opened, EVERYTHING)
    assert "Nothing of the surface is inside" in opened.inner_text("#hint")


def shape_in_colour(shape, away):
    """What a page shows of triangles without bands, that are looked at from `away`."""
    positions = FRAME.to_world(np.array(shape.vertices))
    areas = vertex_areas(trimesh.triangles.area(positions[shape.faces]), shape.faces, len(positions))
    facts = {"lights": [{"name": "white", "factors": [], "notes": []}], "notes": [], "colour": "grey"}
    arrays = {"positions": positions, "faces": np.array(shape.faces), "areas": areas}
    content = page.PageContent(arrays, facts, {})
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


@pytest.mark.parametrize(
    ("shape", "away"),
    [(plate(), (0.3, 0.2, 1.0)), (sheet(), (0.3, 0.2, 1.0)), (sheet(), (0.3, 0.2, -1.0))],
    ids=["plate", "sheet", "sheet from its back"],
)
def test_one_side_of_something_thin_is_seen(shape, away, browser, tmp_path):
    _, _, path = export(tmp_path, shape_in_colour(shape, away), {})
    with looking(browser, path) as opened:
        stroke(opened, EVERYTHING)
        (seen,) = probes(opened, "area")
    assert seen["area"] == pytest.approx(1 / FRAME.scale**2, rel=0.08)


NOTE = "</script><script>document.title=1</script>\n<img src=x onerror='document.title=1'> {{ facts }} é"


def saved_copy(opened, path):
    opened.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    with opened.expect_download() as saving:
        opened.click("#copy")
    saving.value.save_as(path)
    return path


def test_notes_at_places_travel_in_copies_of_the_page(exported, browser, tmp_path):
    Image.new("RGBA", (3000, 500), (255, 0, 0, 255)).save(tmp_path / "picture.png")
    (tmp_path / "none.png").write_text("no picture")
    stored = "unmixPage.notes.map(({ text, place, from, picture }) => [text, place.toArray(), from.toArray(), picture])"
    with looking(browser, exported[2]) as opened:
        opened.evaluate("(unmixPage.wholeObject(), unmixPage.draw())")
        opened.keyboard.press("n")
        opened.mouse.click(285, 300)
        opened.keyboard.type(NOTE)
        place = opened.evaluate("unmixPage.pick(285, 300).place.toArray()")
        opened.locator("#notes input[type=file]").set_input_files(tmp_path / "none.png")
        opened.locator("#noted", has_text="none.png is no picture").wait_for()
        opened.locator("#notes input[type=file]").set_input_files(tmp_path / "picture.png")
        opened.wait_for_selector("#notes img")
        before = opened.evaluate(stored)
        assert "Not saved yet" in opened.inner_text("#noted")
        copy = saved_copy(opened, tmp_path / "copy.html")
        assert not opened.inner_text("#noted")
        assert not opened.evaluate("unmixPage.probes.length > 2")  # the click was for the note
    with looking(browser, copy) as opened:
        ((text, at, _, picture),) = after = opened.evaluate(stored)
        assert (text, opened.title()) == (NOTE, TITLE)
        np.testing.assert_allclose(at, place, atol=1e-6 * WORLD_RADIUS)
        for one, other in zip(before[0][1:3], after[0][1:3], strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)
        shown = Image.open(io.BytesIO(base64.b64decode(picture.split(",")[1])))
        assert (shown.size, before[0][3]) == ((1024, 171), picture)
        opened.evaluate("unmixPage.draw()")
        assert "1 </script>" in opened.inner_text("#labels")
        assert opened.locator("#notes textarea").input_value() == NOTE
        assert saved_copy(opened, tmp_path / "again.html").read_bytes() == copy.read_bytes()


def test_notes_that_a_file_makes_up_are_left_out_and_said(exported, browser, tmp_path):
    notes = (
        '[{"text": 1}, null, {"text": "a", "place": [0, 0, 1e999], "from": [0, 0, 0], "picture": null}, '
        '{"text": "a", "place": [0, 0, 0], "from": [1, 1, 1], "picture": "https://example.org/x.png"}]'
    )
    path, page_of = tmp_path / "page.html", exported[2].read_text()
    for content, count in ((notes, 4), ("{", 1)):
        path.write_text(page_of.replace('id="data-notes">[]', f'id="data-notes">{content}'))
        with looking(browser, path) as opened:
            assert opened.evaluate("unmixPage.notes.length") == 0
            assert opened.inner_text("#noted").startswith(f"{count} of the notes in this file can't be read")


def test_labels_do_not_overlap(opened):
    opened.evaluate("(unmixPage.wholeObject(), unmixPage.draw())")
    for row in range(6):
        opened.mouse.click(285, 300 + row)
    opened.evaluate("unmixPage.draw()")
    boxes = [one.bounding_box() for one in opened.locator("#labels .placed").all()]
    assert len(boxes) == 8
    for one, other in itertools.combinations(boxes, 2):
        beside = abs(one["x"] - other["x"]) >= min(one["width"], other["width"])
        assert beside or abs(one["y"] - other["y"]) >= one["height"]
