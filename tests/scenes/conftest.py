"""A sound scene, which a test may damage."""

import pytest

from tests.factories.scenes import SceneFolder, make_scene


@pytest.fixture
def folder(tmp_path) -> SceneFolder:
    return make_scene(tmp_path / "scene")
