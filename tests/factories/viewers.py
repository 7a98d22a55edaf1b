"""Pages of a viewer, over its own protocol and without a browser."""

import io
from contextlib import contextmanager

import numpy as np
from PIL import Image

from tests.factories.viewer_page import Page
from tests.factories.views import no_scene
from unmix_plugin.viewer.access import ViewerOptions
from unmix_plugin.viewer.server import Viewer
from unmix_plugin.viewer.session import Services


@contextmanager
def serving(source, read_scene=no_scene, **options):
    """A viewer that listens at any free port, and what it said."""
    lines = []
    viewing = ViewerOptions(**{"port": 0, **options})
    services = Services(source, read_scene, environments=viewing.environments)
    viewer = Viewer(services, viewing, lines.append)
    viewer.start()
    try:
        yield viewer, lines
    finally:
        viewer.stop()


def page_of(viewer, **settings):
    return Page(f"ws://127.0.0.1:{viewer.port}", **settings)


@contextmanager
def opened(viewer, rows=24, **settings):
    """A page that has its first picture and all of its controls; its finest picture has few rows."""
    with page_of(viewer, **settings) as page:
        page.look_from(0.3)
        page.wait_until(lambda: bool(page.pictures) and has_control(page, "render a video"))
        page.set("picture height (px)", rows)
        page.wait_until(lambda: len(decoded(page.last_picture)) == rows)
        yield page


def has_control(page, label):
    return any(props.get("label") == label for props in page.controls.values())


def decoded(picture):
    return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB")).astype(float)


def show_layer(page, title):
    count = len(page.pictures)
    page.set("layer", title)
    page.wait_until(lambda: len(page.pictures) > count)
    return decoded(page.last_picture)
