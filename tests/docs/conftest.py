"""A trained run where the pages have theirs, and the code that is on them."""

import os
import shutil
from pathlib import Path

import pytest

from tests.commands.conftest import Trained, trained

__all__ = ["trained"]


@pytest.fixture
def home(trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory of a reader who has a scene and a run as in the examples, and a recipe."""
    shutil.copytree(trained.run, tmp_path / "outputs/my-scene/unmix-nerf/2026-01-31_120000")
    recipe = (
        "edits:\n  - rename: {endmember: 2, name: wood}\n  - retint: {endmember: wood, colour: '#3366cc'}\n"
    )
    (tmp_path / "edits.yml").write_text(recipe)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(os.environ, "MPLBACKEND", "agg")
    return tmp_path
