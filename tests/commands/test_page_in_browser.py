"""The exported page in a real browser: its layers against renders of the same cameras, its probe, its layout."""

from __future__ import annotations

import base64
import io
import itertools

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import binary_erosion
from skimage.color import deltaE_ciede2000, rgb2lab

from tests.commands.browser import CHROMIUM, FLAGS, HAS_BROWSER, SOFTWARE_GL
from tests.commands.running import done
from unmix_plugin.commands.export import export
from unmix_plugin.commands.train import train
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.trained.open_run import open_run

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not HAS_BROWSER, reason="needs the package playwright and the program chromium"),
]

SIDE = 256
NAME = '<b>matt</b> & "bright"</script>'


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A trained run and its page, with markup in its title."""
    folder = tmp_path_factory.mktemp("page")
    make_demo_scene(folder / "scene", 96, 8, 32)
    given = ["--data", folder / "scene", "--output-dir", folder / "outputs", "--max-num-iterations", 400]
    ended = done(train, "unmix-nerf", *given, "--pipeline.model.num-endmembers=5")
    path = ended.last_line.removeprefix("run: ")
    done(export, "page", "--run", path, "--output", folder, "--title", NAME, "--resolution=128")
    return open_run(path), folder / "page.html"


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as session:
        flags = [flag for flag in FLAGS if flag not in ("--headless", "--disable-gpu")]
        found = session.chromium.launch(executable_path=CHROMIUM, args=[*flags, *SOFTWARE_GL])
        yield found
        found.close()


@pytest.fixture
def opened(exported, browser, request):
    """The page from its file, without a network, in a window of the size asked for."""
    width, height = getattr(request, "param", (SIDE, SIDE))
    context = browser.new_context(viewport={"width": width, "height": height}, offline=True)
    page = context.new_page()
    said = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on(
        "request",
        lambda asked: (
            said.append(asked.url) if not asked.url.startswith(("file:", "blob:", "data:")) else None
        ),
    )
    page.goto(exported[1].as_uri())
    page.wait_for_function("window.unmixPage")
    yield page
    assert said == []
    context.close()


def picture(page, layer):
    """What the canvas shows of a layer, sRGB in [0, 1]."""
    page.evaluate(f"unmixPage.choose('{layer}')")
    url = page.evaluate("(unmixPage.draw(), document.querySelector('canvas').toDataURL())")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")) / 255


def test_layers_match_renders_of_the_same_camera(exported, opened):
    scene, _ = exported
    view = scene.views[-1]
    opened.evaluate(
        f"unmixPage.lookThrough(unmixPage.facts.cameras.findIndex((one) => one.name === '{view.name}'))"
    )
    rendered = scene.look(view.camera.resized(SIDE, SIDE))
    inside = binary_erosion(rendered.opacity.numpy() > 0.97, iterations=4)
    band = f"band:{scene.bands.centers_nm[len(scene.bands) // 2]}nm"
    grey = np.repeat(rendered[band].numpy()[..., None], 3, axis=-1)
    expected = {"colour": rendered["rgb"].numpy(), "band": srgb(grey)}
    for layer, truth in expected.items():
        off = deltaE_ciede2000(rgb2lab(truth), rgb2lab(picture(opened, layer)))[inside]
        assert np.median(off) < 3, (layer, np.median(off))


def srgb(linear):
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_all_layers_differ(opened):
    layers = opened.evaluate("[...document.querySelectorAll('#layer option')].map((one) => one.value)")
    opened.evaluate("unmixPage.state.formula = 'r650/r550'")
    shown = [picture(opened, layer) for layer in layers]
    assert len(layers) == 7
    opened.evaluate("unmixPage.choose('materials')")
    areas = opened.evaluate("unmixPage.materialAreas")
    texts = [
        float(text.split(": ")[1].split()[0]) for text in opened.locator("#legend .key").all_inner_texts()
    ]
    assert texts == pytest.approx([area for area in areas if area > 0], rel=1e-3)
    assert (opened.inner_text("#head h1"), opened.title()) == (NAME, NAME)
    opened.evaluate("(unmixPage.state.formula = 'r650 +', unmixPage.choose('index'))")
    assert "the formula ends too early" in opened.inner_text("#about")
    for index, one in enumerate(shown):
        assert all(np.abs(one - other).mean() > 0.004 for other in shown[:index]), layers[index]


@pytest.mark.parametrize("opened", [(1440, 900), (390, 844)], indirect=True)
@pytest.mark.parametrize("folded", [True, False])
def test_the_object_is_not_under_the_panel(opened, folded):
    opened.evaluate(f"document.querySelector('#panel.folded') ? {int(folded)} || unmixPage.fold() : 0")
    opened.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    opened.evaluate("unmixPage.wholeObject()")
    opened.wait_for_timeout(300)
    box, size = opened.locator("#panel").bounding_box(), opened.viewport_size
    columns, rows = np.nonzero(drawn(opened).T)
    is_phone = size["width"] <= 700
    assert 0 < columns.min() < columns.max() < (size["width"] if is_phone else box["x"])
    assert 0 < rows.min() < rows.max() < (box["y"] if is_phone else size["height"])
    assert opened.evaluate("document.documentElement.scrollWidth") <= size["width"]


def drawn(opened):
    """Pixels of the window that differ from its ground."""
    url = opened.evaluate("(unmixPage.draw(), document.querySelector('canvas').toDataURL())")
    picture = Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")
    pixels = np.asarray(picture).astype(int)
    return np.abs(pixels - pixels[2, 2]).max(axis=2) > 12


def test_nothing_is_cut_off_however_far_one_goes_away(opened):
    turn = "document.querySelector('canvas').dispatchEvent(new WheelEvent('wheel', { deltaY: 400 }))"
    counts = [drawn(opened).sum()]
    for _ in range(3):
        opened.evaluate(f"for (let i = 0; i < 6; i++) {turn}")
        counts.append(drawn(opened).sum())
    assert all(after < before for before, after in itertools.pairwise(counts))
    assert counts[-1] > 8
