"""Writing results: whole or not at all, and nothing lost by accident."""

import errno
import os

import numpy as np
import pytest
import torch

from tests.engine.rgb_nerf_plugin import RgbNerf, rgb_nerf
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.scene_box import SceneBox
from unmix_plugin.engine.runs.load_run import SceneRecord
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.formats.files import array_bytes, make_folder, refuse_to_overwrite, write_file
from unmix_plugin.trained.run_materials import has_materials, materials_of
from unmix_plugin.trained.run_views import views_of


def test_a_file_is_written_into_a_folder_made_for_it(tmp_path):
    path = write_file(tmp_path / "a" / "b.npy", array_bytes(np.arange(3)))
    np.testing.assert_array_equal(np.load(path), [0, 1, 2])
    assert [file.name for file in path.parent.iterdir()] == ["b.npy"]


def test_a_full_disk_keeps_the_old_file_and_says_what_to_do(tmp_path, monkeypatch):
    def full(*_args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = write_file(tmp_path / "file", b"old")
    monkeypatch.setattr(os, "write", full)
    with pytest.raises(RunError, match=r"can't write .*file: No space left on device; make room"):
        write_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


def test_existing_files_are_counted_and_refused_unless_overwriting_was_asked_for(tmp_path):
    paths = [tmp_path / name for name in "abc"]
    refuse_to_overwrite(paths, overwrite=False)
    for path in paths[1:]:
        path.write_bytes(b"")
    with pytest.raises(ConfigError, match=r"b and 1 more of its files exist already; give --overwrite"):
        refuse_to_overwrite(paths, overwrite=False)
    refuse_to_overwrite(paths, overwrite=True)


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RunError, match="can't make the folder"):
        make_folder(tmp_path / "file" / "folder")


def test_a_method_that_does_not_unmix_spectra_has_no_materials():
    model = rgb_nerf.config.pipeline.model.setup(
        scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), metadata={"grid_size": 4}
    )
    assert isinstance(model, RgbNerf)
    assert not has_materials(model)
    with pytest.raises(ConfigError, match="RgbNerf has no endmembers"):
        materials_of(model)


def cameras(count):
    pose = torch.eye(4)[:3].expand(count, 3, 4) + torch.arange(count)[:, None, None]
    return Cameras(pose, torch.ones(count, 2), torch.ones(count, 2), torch.zeros(count, 4), 2, 2)


def record(summary):
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    return SceneRecord(box, {}, cameras(2), cameras(1), summary)


def test_views_are_named_as_the_frames_of_the_scene():
    scene = record({"frames": ["x", "y", "z"], "train_indices": [0, 2], "eval_indices": [1]})
    assert [view.name for view in views_of(scene, "eval")] == ["y"]
    assert [view.name for view in views_of(scene, "train")] == ["x", "z"]
    assert [view.name for view in views_of(scene, "all")] == ["y", "x", "z"]
    last = views_of(scene, "train")[-1].camera
    torch.testing.assert_close(last.camera_to_world, scene.train_cameras.camera_to_world[1:])


def test_views_of_a_scene_without_frame_names_are_numbered():
    assert [view.name for view in views_of(record({}), "all")] == ["eval_000", "train_000", "train_001"]
