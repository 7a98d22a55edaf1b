"""What tests of many rooms share."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

from unmix_plugin.errors import SceneError


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], Any]], Any]:
    """`made_once(name, make)` is what `make(folder)` gave in the first process of this test run that asked for it."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def once(name: str, make: Callable[[Path], Any]) -> Any:
        folder, kept = shared / name, shared / f"{name}.pickle"
        with FileLock(f"{folder}.lock"):
            if not kept.exists():
                folder.mkdir()
                kept.write_bytes(pickle.dumps(make(folder)))
        return pickle.loads(kept.read_bytes())

    return once


@pytest.fixture(autouse=True)
def nothing_judged_before(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch):
    """Each test judges its scenes itself, unless it asks for what is kept."""
    if "judged_before" in request.fixturenames:
        return

    def none():
        raise SceneError("nothing is kept in tests")

    monkeypatch.setattr("unmix_plugin.scenes.kept.user_cache", none)


@pytest.fixture
def judged_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own, in which what is judged of scenes is kept; the folder of the judgements."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "unmix-nerf" / "judged"


@pytest.fixture(scope="module")
def no_wait_for_the_disk():
    """Hundreds of small files would otherwise be forced to disk one by one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _descriptor: None)
        yield


@pytest.fixture(scope="module")
def coarse_hulls():
    """Hulls that decide how large a scene is, and whether masks agree, of cells as small pictures need them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("unmix_plugin.scenes.geometry.bounds._HULL_CELLS", 32)
        patch.setattr("unmix_plugin.scenes.geometry.carving._WITNESS_CELLS", 32)
        yield


@pytest.fixture
def contact_sheet():
    """For tests that want the contact sheet of the scenes that they write."""


@pytest.fixture
def no_contact_sheet(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch):
    """Scenes are written without one where no test asks for it: drawing takes longer than all else of small ones."""
    if "contact_sheet" not in request.fixturenames:
        monkeypatch.setattr("unmix_plugin.captures.writing.scene_files.contact_sheet", lambda *_: b"")


@pytest.fixture
def few_searches(monkeypatch: pytest.MonkeyPatch):
    """A shorter pooled search for endmembers, where a test does not ask how good they are."""
    for name, value in (("_REPEATS", 1), ("_OUTER_STEPS", 6), ("_PURITY_PRICES", (0.0, 0.1, 0.3))):
        monkeypatch.setattr(f"unmix_plugin.spectral.unmixing.pooled_search.{name}", value)
