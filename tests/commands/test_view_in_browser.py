"""The viewer in a real browser: every layer, the camera, a probe, an edit, a recipe and a screenshot."""

from __future__ import annotations

import io
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.factories.commands import CHROMIUM, FLAGS, NEEDS_BROWSER
from tests.factories.viewers import serving
from tests.factories.views import make_source
from unmix_plugin.commands.view import ViewOptions, prepared
from unmix_plugin.viewer.access import ViewerOptions
from unmix_plugin.viewer.rendering.painting import LAYERS

pytestmark = [pytest.mark.slow, NEEDS_BROWSER]

WIDTH, HEIGHT, PANEL = 1000, 420, 400
WAIT_MS = 60_000
LEAST_SPREAD = 4.0
"""Standard deviation of 8-bit values under which a picture counts as blank."""


class Browser:
    """One page, and what of it is picture."""

    def __init__(self, page, folder):
        self.page, self.folder = page, folder

    def picture(self):
        """The canvas without the panel, as 8-bit values."""
        clip = {"x": 0, "y": 0, "width": WIDTH - PANEL, "height": HEIGHT}
        shot = Image.open(io.BytesIO(self.page.screenshot(clip=clip))).convert("RGB")
        return np.asarray(shot).astype(float)

    def keep(self, name):
        """Keep a screenshot of all of the page for whoever looks at it."""
        self.page.screenshot(path=str(self.folder / f"{name.replace(' ', '_')}.png"))

    def wait_for_picture(self, holds):
        """The first picture for which something holds."""
        return first_of(self.picture, holds, f"picture; see {self.folder}")

    def wait_for_other(self, before):
        """The first picture that differs from one before and is not blank."""
        return self.wait_for_picture(
            lambda picture: np.abs(picture - before).mean() > 0.3 and picture.std() > LEAST_SPREAD
        )

    def open_tab(self, name):
        self.page.get_by_role("tab", name=name).click()

    def choose(self, label, option):
        """Choose from the list with a label in the tab that is open."""
        self.field(label).click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def type(self, label, value):
        """Type into the field with a label in the tab that is open."""
        self.field(label).fill(value)
        self.field(label).press("Tab")

    def field(self, label):
        return self.page.get_by_label(label, exact=True).locator("visible=true").first


@pytest.fixture
def viewer(run_copy):
    served = prepared(ViewOptions(run=run_copy, device="cpu", viewer=ViewerOptions(port=0)))
    served.start()
    yield served
    served.stop()


@pytest.fixture
def browser(viewer, tmp_path):
    from playwright.sync_api import sync_playwright

    folder = tmp_path / "screenshots"
    folder.mkdir()
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        page = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(WAIT_MS)
        errors = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(f"http://127.0.0.1:{viewer.port}")
        page.get_by_role("tab", name="capture").wait_for()
        yield Browser(page, folder)
        assert errors == []
        chromium.close()


def first_of(make, holds, what):
    """The first thing made for which something holds."""
    until = time.monotonic() + WAIT_MS / 1000
    while time.monotonic() < until:
        if holds(found := make()):
            return found
        time.sleep(0.1)
    raise AssertionError(f"there came no such {what}")


def wait_for_file(folder: Path, pattern: str) -> Path:
    def written():
        """Those that are complete: an empty one only claims its name."""
        return [path for path in folder.glob(pattern) if path.stat().st_size > 0]

    return first_of(written, bool, f"{pattern} in {folder}")[0]


def test_a_run_is_looked_at_probed_edited_and_saved(viewer, browser):
    page = browser.page
    shown = browser.wait_for_picture(lambda picture: picture.std() > LEAST_SPREAD)
    browser.keep("first")
    viewer.services.wait_for_scene()

    for name, layer in list(LAYERS.items())[1:]:
        browser.choose("layer", layer.title)
        shown = browser.wait_for_other(shown)
        browser.keep(f"layer_{name}")
    browser.choose("layer", LAYERS["rgb"].title)
    shown = browser.wait_for_other(shown)

    middle = ((WIDTH - PANEL) / 2, HEIGHT / 2)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 120, middle[1] + 40, steps=5)
    page.mouse.up()
    browser.wait_for_other(shown)
    browser.keep("moved")

    browser.open_tab("probe")
    page.mouse.click(*middle)
    page.get_by_text("position", exact=True).wait_for()
    page.locator("canvas:visible").nth(1).wait_for()  # the chart, beside the scene
    browser.keep("probe")

    browser.open_tab("materials")
    shown = browser.picture()
    browser.choose("light", "A: incandescent lamp, 2856 K")
    shown = browser.wait_for_other(shown)
    browser.keep("edited")
    page.get_by_role("button", name="save", exact=True).click()
    recipe = wait_for_file(viewer.services.recipes_folder, "*.yml")
    assert "illuminant: A" in recipe.read_text()

    browser.open_tab("capture")
    browser.type("width", "240")
    browser.type("height", "160")
    page.get_by_role("button", name="save a screenshot (PNG)").click()
    saved = wait_for_file(viewer.services.folder, "*.png")
    with Image.open(saved) as picture:
        assert picture.size == (240, 160)
        assert np.asarray(picture).std() > LEAST_SPREAD
    browser.keep("captured")


@pytest.mark.parametrize("size", [(1280, 800), (1440, 900)])
def test_tabs_lie_in_one_row_and_the_object_in_the_part_beside_them(browser, size):
    width, height = size
    browser.page.set_viewport_size({"width": width, "height": height})
    tabs = browser.page.get_by_role("tab").all()
    boxes = [tab.bounding_box() for tab in tabs]
    assert len({box["y"] for box in boxes}) == 1
    assert max(box["x"] + box["width"] for box in boxes) <= width
    left = round(min(box["x"] for box in boxes)) - 8

    def columns():
        """Where the picture is not background, as parts of what is beside the controls."""
        clip = {"x": 0, "y": 200, "width": left, "height": height - 300}  # below a notice of the browser's
        shot = np.asarray(Image.open(io.BytesIO(browser.page.screenshot(clip=clip))).convert("RGB")).astype(
            float
        )
        is_object = np.abs(shot - shot[0, 0]).max(axis=-1) > 30
        return np.flatnonzero(is_object.any(axis=0)) / left

    found = first_of(columns, lambda places: len(places) > 0, "object")
    browser.keep(f"at_{width}")
    assert found.min() > 0.02
    assert found.max() < 0.98
    assert abs((found.min() + found.max()) / 2 - 0.5) < 0.1


def test_a_browser_gives_the_token_once_and_is_let_in(tmp_path):
    from playwright.sync_api import sync_playwright

    source = make_source(tmp_path)
    with serving(source, token="sésame") as (viewer, _), sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        page = chromium.new_page()
        page.set_default_timeout(WAIT_MS)
        page.goto(f"http://127.0.0.1:{viewer.port}")
        page.get_by_label("token").fill("barley")
        page.get_by_role("button").click()
        page.get_by_text("That is not the token.").wait_for()
        page.get_by_label("token").fill("sésame")
        page.get_by_role("button").click()
        page.get_by_role("tab", name="capture").wait_for()
        page.reload()
        page.get_by_role("tab", name="capture").wait_for()
        assert page.title().endswith(" - unmix-nerf")
        chromium.close()
