"""A tiny run to look at, without training and without a browser."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.factories.models import make_model
from tests.factories.viewer_page import Page
from tests.factories.viewers import opened, serving
from tests.factories.views import make_source, source_of_model
from unmix_plugin.model import UnmixModel
from unmix_plugin.viewer.rendering.scene import SceneSource
from unmix_plugin.viewer.server import Viewer


@pytest.fixture
def model() -> UnmixModel:
    """The model that `source` takes its scenes from."""
    return make_model()


@pytest.fixture
def source(tmp_path: Path, model: UnmixModel) -> SceneSource:
    """A model of random blobs seen by a ring of cameras, in a run folder of its own."""
    return source_of_model(model, tmp_path)


@pytest.fixture(scope="module")
def shared_viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """Such a source, served at any free port to all pages of a module."""
    with serving(make_source(tmp_path_factory.mktemp("run"))) as (running, _):
        yield running


@pytest.fixture
def viewer(shared_viewer: Viewer) -> Viewer:
    """The same without the pages and the files of the tests before."""
    until = time.monotonic() + 60
    while shared_viewer.sessions:
        assert time.monotonic() < until
        time.sleep(0.01)
    for folder in (shared_viewer.services.folder, shared_viewer.services.recipes_folder):
        shutil.rmtree(folder, ignore_errors=True)
    return shared_viewer


@pytest.fixture
def page(viewer: Viewer) -> Iterator[Page]:
    """A page of it."""
    with opened(viewer) as running:
        yield running
