"""A run folder from a stranger writes nowhere but in itself, and says what is wrong with it."""

import hashlib
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from unmix_plugin.engine.runs.atomic_files import whole_file, write_file
from unmix_plugin.engine.runs.load_run import load_config, load_model
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.errors import RunError


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


@pytest.mark.parametrize(
    "name", ["/tmp/x", "../../x", "a/b", "..", ".", "", "a\nb", "a\0b", "\ud800", 3, None]
)
def test_a_view_whose_name_is_no_plain_file_name_is_refused(trained: RunFolder, name: object):
    rewrite(trained.scene_path, lambda scene: scene["summary"].update(frames=["a", name]))
    with pytest.raises(RunError, match=r"scene\.json"):
        load_model(trained.path, "cpu")


def test_two_views_of_one_name_are_refused(trained: RunFolder):
    rewrite(trained.scene_path, lambda scene: scene["summary"].update(frames=["a", "a"]))
    with pytest.raises(RunError, match="different names"):
        load_model(trained.path, "cpu")


@pytest.mark.parametrize("name", ["eval", "run.log", "checkpoints/extra", "exports/render"])
def test_a_link_that_leads_out_of_the_folder_is_refused(trained: RunFolder, name: str, tmp_path: Path):
    link = trained.path / name
    link.unlink(missing_ok=True)
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunError, match="link that leads out of the run folder"):
        load_model(trained.path, "cpu")


def test_a_link_within_the_folder_is_fine(trained: RunFolder):
    (trained.path / "newest.json").symlink_to(trained.scene_path)
    assert load_model(trained.path, "cpu").training.steps == 12


@pytest.mark.parametrize("stream", [False, True])
def test_a_link_in_the_temporarys_place_is_not_followed(tmp_path: Path, stream: bool):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / ".out.tmp").symlink_to(victim)
    if stream:
        with whole_file(tmp_path / "out") as temporary:
            temporary.write_bytes(b"new")
    else:
        write_file(tmp_path / "out", b"new")
    assert victim.read_text() == "precious"
    assert (tmp_path / "out").read_bytes() == b"new"
    assert not (tmp_path / "out").is_symlink()


CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "no box": lambda scene: scene.pop("scene_box"),
    "box of text": lambda scene: scene.update(scene_box="big"),
    "box inside out": lambda scene: scene.update(scene_box=[[1, 1, 1], [0, 0, 0]]),
    "box of another shape": lambda scene: scene.update(scene_box=[1, 2]),
    "metadata a list": lambda scene: scene.update(metadata=[]),
    "no metadata": lambda scene: scene.update(metadata={}),
    "metadata of text": lambda scene: scene["metadata"].update(grid_size="x"),
    "summary null": lambda scene: scene.update(summary=None),
    "cameras null": lambda scene: scene.update(eval_cameras=None),
    "cameras ragged": lambda scene: scene["eval_cameras"]["camera_to_world"].append([1]),
    "too few lenses": lambda scene: scene["eval_cameras"]["focal_px"].pop(),
    "no width": lambda scene: scene["eval_cameras"].update(width=0),
    "width of text": lambda scene: scene["eval_cameras"].update(width="20"),
    "huge": lambda scene: scene["eval_cameras"].update(height=10**12),
    "beyond 64 bits": lambda scene: scene["eval_cameras"].update(height=10**40),
    "infinite lens": lambda scene: scene["eval_cameras"]["focal_px"].__setitem__(0, [1e60, 1e60]),
    "indices beyond": lambda scene: scene["summary"].update(frames=["a"], eval_indices=[0, 7]),
    "indices of text": lambda scene: scene["summary"].update(frames=["a", "b"], eval_indices=["0", "1"]),
    "frames of text": lambda scene: scene["summary"].update(frames="ab"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_scene_of_another_shape_is_refused(trained: RunFolder, name: str):
    rewrite(trained.scene_path, CHANGES[name])
    with pytest.raises(RunError, match=r"scene\.json"):
        load_model(trained.path, "cpu")


@pytest.mark.parametrize("name", ["config.json", "scene.json"])
@pytest.mark.parametrize(
    "value", ["[" * 100 + "]" * 100, "[" * 200_000, "NaN", "1e999", '"\\u0000"', '"\\ud800"']
)
def test_json_that_no_run_writes_is_refused(trained: RunFolder, name: str, value: str):
    (trained.path / name).write_text(f'{{"format_version": 3, "config": {value}, "scene_box": {value}}}')
    with pytest.raises(RunError, match=name):
        load_model(trained.path, "cpu")


@pytest.mark.parametrize("rays", [0, -1, 10**15])
def test_a_setting_out_of_its_range_is_refused_by_name(trained: RunFolder, rays: int):
    change = {"eval_num_rays_per_chunk": rays}
    rewrite(trained.config_path, lambda values: values["config"]["pipeline"]["model"].update(change))
    with pytest.raises(RunError, match="eval_num_rays_per_chunk must be from 1"):
        load_model(trained.path, "cpu")


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff" * 8,
        struct.pack("<Q", 2) + b"{}trailing",
        struct.pack("<Q", 60) + b'{"a": {"dtype": "F32", "shape": [1], "data_offsets": [0, 9]}}',
        struct.pack("<Q", 4) + b"[[[[",
    ],
)
def test_tensors_with_the_right_hash_and_a_bad_header_are_passed_over(trained: RunFolder, data: bytes):
    for record in trained.checkpoints.glob("*.json"):
        record.with_suffix(".safetensors").write_bytes(data)
        rewrite(record, lambda values: values.update(sha256=hashlib.sha256(data).hexdigest()))
    with pytest.raises(RunError, match=r"no complete checkpoint|does not fit the model"):
        load_model(trained.path, "cpu")


@pytest.mark.parametrize(
    ("name", "value"),
    [("steps", "many"), ("steps", -1), ("num_rays", 0), ("learning_rates", 3), ("train_seconds", None)],
)
def test_a_record_of_another_shape_is_refused(trained: RunFolder, name: str, value: object):
    for record in trained.checkpoints.glob("*.json"):
        rewrite(record, lambda values: values.update({name: value}))
    with pytest.raises(RunError, match=name):
        load_model(trained.path, "cpu")


def test_odd_lines_of_metrics_are_dropped_on_resume(trained: RunFolder):
    good = trained.metrics_path.read_bytes()
    trained.metrics_path.write_bytes(good + b"\xff\xfe\n" + b"[" * 100_000 + b"\nnull\n[1]\n{}\n")
    Trainer(load_config(trained.path))
    assert trained.metrics_path.read_bytes() == good
