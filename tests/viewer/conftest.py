"""A tiny run to look at, without training and without a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.method_factory import make_model
from tests.viewer.pages import serving
from tests.viewer.view_factory import source_of_model
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


@pytest.fixture
def viewer(source: SceneSource) -> Iterator[Viewer]:
    """The same source, served at any free port."""
    with serving(source) as (running, _):
        yield running
