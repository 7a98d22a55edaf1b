"""A tiny run to look at, without training and without a browser."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.viewer.view_factory import make_source
from unmix_plugin.viewer.model_source import ModelSource


@pytest.fixture
def source(tmp_path: Path) -> ModelSource:
    """A model of random blobs seen by a ring of cameras, in a run folder of its own."""
    return make_source(tmp_path)
