"""What pages share, and what a page that is loaded again goes on with."""

import time

import numpy as np

from tests.factories.viewers import decoded, opened, page_of, show_layer
from tests.factories.views import make_source, no_scene
from unmix_plugin.engine.training.progress import TrainingStatus
from unmix_plugin.engine.training.training_control import TrainingControl
from unmix_plugin.viewer.recipes import RecipeHistory
from unmix_plugin.viewer.rendering.settings import LayerSettings
from unmix_plugin.viewer.server import KeptPages
from unmix_plugin.viewer.session import PageState, Services


def state(rows):
    return PageState(LayerSettings(), RecipeHistory(), rows)


def test_the_page_that_was_closed_last_comes_back_first_and_once_unless_that_is_long_ago():
    now = [0.0]
    pages = KeptPages(lambda: now[0])
    for rows in (100, 200):
        pages.leave("mine", state(rows))
    pages.leave("other", state(300))
    kept = [pages.take("mine") for _ in range(3)]
    assert [one and one.largest_height for one in kept] == [200, 100, None]
    now[0] = 600.0
    assert pages.take("other") is None


def test_a_reload_keeps_camera_layer_and_edits_and_another_browser_starts_anew(viewer):
    storage = {}
    with opened(viewer, storage=storage) as page:
        page.look_from(1.7)
        page.set("brightness", 3.0)
        page.wait_until(lambda: "scale" in page.props("recipe")["value"])
        before = show_layer(page, "all abundances")
        page.wait_until(lambda: len(decoded(page.last_picture)) == 24)
        time.sleep(0.5)  # the edit can reach the picture after the layer
        before = decoded(page.last_picture)
    until = time.monotonic() + 60
    while viewer.sessions:
        assert time.monotonic() < until
        time.sleep(0.01)
    with page_of(viewer, storage=storage) as page:
        page.look_from(0.3)
        page.wait_until(lambda: bool(page.pictures) and len(decoded(page.last_picture)) == 24)
        page.wait_until(lambda: np.allclose(decoded(page.last_picture), before, rtol=0, atol=2))
        assert page.props("layer")["value"] == "all abundances"
        assert "scale" in page.props("recipe")["value"]
        page.set("changes", "undo")
        page.wait_until(lambda: page.props("recipe")["value"] == "edits: []\n")
    with opened(viewer) as page:
        assert page.props("layer")["value"] == "colour"
        assert page.props("recipe")["value"] == "edits: []\n"


def test_the_curve_of_a_training_has_every_point_once_stays_small_and_covers_all_of_it(tmp_path):
    control = TrainingControl()
    services = Services(make_source(tmp_path, control), no_scene)

    def follow(steps):
        for step in steps:
            control.status = TrainingStatus(step, float(step), step / 10_000, 1.0 / step, 20.0, 100.0)
            services.tick()
        return [point.step for point in services.curve]

    services.tick()
    assert follow((1, 2, 2, 3, 1)) == [1, 2, 3]
    steps = follow(range(4, 10_001))
    assert 100 <= len(steps) <= 400
    assert (steps[0], steps[-1] > 9_900) == (1, True)
    assert np.diff(steps).max() <= 2 * np.diff(steps).min()
