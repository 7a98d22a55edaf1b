"""A start that was cut off is gone on with, and a scene is never half there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.captures.capture_factory import make_capture, process
from unmix_plugin.captures import process as process_module
from unmix_plugin.captures.writing.view_files import write_view
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.reading.loader import load_scene


class _Writer:
    """Writes views and counts them; stops at one of them in the way of a kill."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.stop_at, self.written = stop_at, []

    def __call__(self, view, recipe, folder):
        if len(self.written) == self.stop_at:
            raise KeyboardInterrupt
        self.written.append(view.name)
        return write_view(view, recipe, folder)


@pytest.fixture
def interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A capture of 4 views of which 2 are written."""
    capture = make_capture(tmp_path / "capture")
    monkeypatch.setattr(process_module, "write_view", _Writer(stop_at=2))
    with pytest.raises(KeyboardInterrupt):
        process(capture.root, tmp_path / "scene")
    return capture


def _write_with(monkeypatch: pytest.MonkeyPatch) -> _Writer:
    writer = _Writer()
    monkeypatch.setattr(process_module, "write_view", writer)
    return writer


@pytest.mark.usefixtures("interrupted")
def test_what_is_half_there_is_no_scene(tmp_path: Path):
    assert not (tmp_path / "scene").exists()
    assert len(list((tmp_path / "scene.unfinished" / "cubes").glob("*.npy"))) == 2
    assert not (tmp_path / "scene.unfinished" / "transforms.json").exists()


def test_the_next_start_goes_on_with_the_next_view(interrupted, tmp_path: Path, monkeypatch):
    writer = _write_with(monkeypatch)
    process(interrupted.root, tmp_path / "scene")
    assert writer.written == ["view_02", "view_03"]
    assert not (tmp_path / "scene.unfinished").exists()
    process(interrupted.root, tmp_path / "whole")
    for path in sorted((tmp_path / "whole").rglob("*")):
        if path.is_file() and path.name != "process.json":
            assert (
                tmp_path / "scene" / path.relative_to(tmp_path / "whole")
            ).read_bytes() == path.read_bytes()
    assert len(load_scene(tmp_path / "scene").frames) == 4


def test_other_options_start_again(interrupted, tmp_path: Path, monkeypatch):
    writer = _write_with(monkeypatch)
    process(interrupted.root, tmp_path / "scene", bin_bands=3)
    assert len(writer.written) == 4


def test_changed_input_starts_again(interrupted, tmp_path: Path, monkeypatch):
    path = interrupted.root / "view_03.raw"
    numbers = np.fromfile(path, "<u2")
    numbers[5] += 1
    numbers.tofile(path)
    writer = _write_with(monkeypatch)
    process(interrupted.root, tmp_path / "scene")
    assert len(writer.written) == 4


def test_a_damaged_record_is_written_again(interrupted, tmp_path: Path, monkeypatch):
    (tmp_path / "scene.unfinished" / "views" / "view_00.json").write_text('{"name": "view')
    writer = _write_with(monkeypatch)
    process(interrupted.root, tmp_path / "scene")
    assert writer.written == ["view_00", "view_02", "view_03"]


def test_a_scene_is_replaced_only_if_asked(tmp_path: Path):
    capture = make_capture(tmp_path / "capture")
    process(capture.root, tmp_path / "scene")
    with pytest.raises(ConfigError, match=r"holds a scene already.*--overwrite"):
        process(capture.root, tmp_path / "scene")
    process(capture.root, tmp_path / "scene", overwrite=True, bin_bands=3)
    assert len(load_scene(tmp_path / "scene").wavelengths_nm) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture", "scene"]


def test_inputs_are_recorded_with_their_hashes(tmp_path: Path):
    import hashlib

    capture = make_capture(tmp_path / "capture")
    process(capture.root, tmp_path / "scene")
    record = json.loads((tmp_path / "scene" / "process.json").read_text())
    for view in record["views"]:
        for source in view["sources"]:
            data = Path(source["path"]).read_bytes()
            assert source["sha256"] == hashlib.sha256(data).hexdigest()
            assert source["bytes"] == len(data)


def test_a_scene_may_be_written_to_the_working_directory(tmp_path: Path, monkeypatch):
    capture = make_capture(tmp_path / "capture")
    (tmp_path / "scene").mkdir()
    monkeypatch.chdir(tmp_path / "scene")
    process(capture.root, Path())
    assert (tmp_path / "scene" / "transforms.json").is_file()


def test_the_root_of_the_disk_is_no_scene(tmp_path: Path):
    with pytest.raises(ConfigError, match="can't be a scene"):
        process(make_capture(tmp_path / "capture").root, Path("/"))
