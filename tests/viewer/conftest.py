"""A tiny run to look at, without training and without a browser."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.viewer.pages import serving
from tests.viewer.view_factory import make_source
from unmix_plugin.viewer.rendering.model_source import ModelSource
from unmix_plugin.viewer.server import Viewer


@pytest.fixture
def source(tmp_path: Path) -> ModelSource:
    """A model of random blobs seen by a ring of cameras, in a run folder of its own."""
    return make_source(tmp_path)


@pytest.fixture
def viewer(source: ModelSource) -> Iterator[Viewer]:
    """The same source, served at any free port."""
    with serving(source) as (running, _):
        yield running
