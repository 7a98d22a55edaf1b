"""A trained run where the pages have theirs, and the code that is on them."""

import os
import shutil
from pathlib import Path

import pytest

from tests.commands.conftest import Trained, coarse_surfaces, trained

__all__ = ["coarse_surfaces", "trained"]


@pytest.fixture
def home(trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory of a reader who has a scene and a run as in the examples, and a recipe."""
    shutil.copytree(trained.run, tmp_path / "outputs/my-scene/unmix-nerf/2026-01-31_120000")
    edits = "rename: {endmember: 2, name: wood}", "retint: {endmember: wood, colour: '#3366cc'}"
    (tmp_path / "edits.yml").write_text("edits:\n" + "".join(f"  - {edit}\n" for edit in edits))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(os.environ, "MPLBACKEND", "agg")
    return tmp_path
