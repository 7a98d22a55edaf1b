"""Run folders: made once each, found again, refused when unusable; one from a stranger writes nowhere but in itself."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.factories.rgb_nerf import RgbNerfConfig
from tests.factories.trainings import quiet_trainer
from unmix_plugin.engine.runs.atomic_files import whole_file, write_file
from unmix_plugin.engine.runs.checkpoints import save_checkpoint
from unmix_plugin.engine.runs.loading import load_config, load_model, load_pipeline
from unmix_plugin.engine.runs.run_folder import RunFolder, create_run_folder, newest_run, open_run_folder
from unmix_plugin.engine.runs.run_json import OLDEST_FORMAT, RUN_FORMAT, write_run_json
from unmix_plugin.engine.runs.scene_record import differences
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.errors import ConfigError, RunError, SceneError, UnmixError, UnmixWarning

NOON = datetime(2024, 5, 6, 12, 0, 7, tzinfo=timezone.utc)


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def complete_run(output_dir: Path, started: datetime, scene: str = "s", checkpoint: bool = True) -> RunFolder:
    run = create_run_folder(output_dir, scene, "m", started)
    for path in (run.config_path, run.scene_path):
        write_run_json(path, {})
    if checkpoint:
        save_checkpoint(run.checkpoints, 1, {"a": torch.zeros(1)}, {})
    return run


def test_a_run_is_named_for_scene_method_and_second_and_shares_its_folder_with_none(tmp_path):
    paths = [create_run_folder(tmp_path, "pots", "unmix", NOON).path for _ in range(12)]
    assert paths[0] == tmp_path / "pots" / "unmix" / "2024-05-06_120007"
    assert len(set(paths)) == 12
    assert all(path.is_dir() for path in paths)


def test_a_scene_name_that_is_no_file_name_stays_inside_the_output_folder(tmp_path):
    for name in ("..", "a/b", "", ".", "x y\n", "nul", "plant."):
        run = create_run_folder(tmp_path, name, "m", NOON)
        assert run.path.parents[2] == tmp_path
        assert run.path.parents[1].name in ("scene", "a_b", "x_y_", "_nul", "plant")


def test_the_newest_run_is_the_one_started_or_resumed_last_whatever_its_name(tmp_path):
    started = ((2099, "a", True), (2026, "b", True), (2024, "c", True), (2027, "d", False))
    runs = [complete_run(tmp_path, NOON.replace(year=year), name, whole) for year, name, whole in started]
    for second, run in enumerate(runs):
        os.utime(run.config_path, (second, second))
    (tmp_path / "a" / "m" / "notes").mkdir()
    assert newest_run(tmp_path) == runs[2]
    os.utime(runs[1].config_path, (9, 9))
    assert newest_run(tmp_path) == runs[1]
    with pytest.raises(RunError, match="no run with a checkpoint under"):
        newest_run(tmp_path / "nothing")


def test_an_output_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(RunError, match="choose another --output-dir"):
        create_run_folder(tmp_path / "file", "s", "m")


def test_a_missing_folder_is_refused(tmp_path):
    for load in (open_run_folder, load_config, load_model, load_pipeline):
        with pytest.raises(RunError, match="no run folder at"):
            load(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["config.json", "scene.json"])
@pytest.mark.parametrize("text", [None, "", '{"format_version": 1, "con', "[]", "{}"])
def test_a_missing_cut_off_or_foreign_file_is_refused(trained, name, text):
    (trained.path / name).unlink()
    if text is not None:
        (trained.path / name).write_text(text)
    with pytest.raises(RunError, match=name if text is not None else f"half-written one: {name} missing"):
        load_model(trained.path)


@pytest.mark.parametrize("name", ["config.json", "scene.json", "checkpoints/step-000012.json"])
@pytest.mark.parametrize(
    ("version", "message"),
    [
        (99, r"format 99, written by a newer version.*update this package"),
        (OLDEST_FORMAT - 1, rf"format {OLDEST_FORMAT - 1}, written by an older version.*train again"),
    ],
)
def test_another_version_is_refused_with_what_to_do(trained, name, version, message):
    rewrite(trained.path / name, lambda values: values.update(format_version=version))
    with pytest.raises(RunError, match=message):
        load_model(trained.path)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (
            "num_samples_per_ray",
            "many",
            r"config\.pipeline\.model\.num_samples_per_ray: expected int, found 'many'",
        ),
        ("eval_num_rays_per_chunk", -1, "eval-num-rays-per-chunk of 256 to 4194304 or auto"),
    ],
)
def test_a_config_that_does_not_fit_its_method_is_refused(trained, name, value, words):
    rewrite(trained.config_path, lambda run: run["config"]["pipeline"]["model"].update({name: value}))
    with pytest.raises(RunError, match=words):
        load_model(trained.path)


def test_a_setting_that_a_config_lacks_is_not_taken_for_the_default(trained):
    rewrite(trained.config_path, lambda run: run["config"]["pipeline"]["model"].pop("num_samples_per_ray"))
    with pytest.raises(RunError, match=r"config\.json lacks pipeline\.model\.num_samples_per_ray"):
        load_model(trained.path)


def test_a_run_is_shown_from_an_older_checkpoint_with_a_warning_alone(trained):
    (trained.checkpoints / "step-000012.safetensors").write_bytes(b"cut")
    for load in (load_model, load_pipeline):
        with pytest.warns(
            UnmixWarning, match=r"as it was after step 8: passed over step-000012: the tensors"
        ):
            assert load(trained.path, "cpu").training.steps == 8
    resumed = quiet_trainer(load_config(trained.path))
    assert resumed.pipeline.reasons.startswith("warning: passed over a damaged checkpoint: step-000012")
    assert resumed.pipeline.reasons in resumed.run.log_path.read_text()


@dataclass(frozen=True)
class Unreadable(RgbNerfConfig):
    widths: Sequence[int] = (64,)


@dataclass(frozen=True)
class ReadAsAnother(RgbNerfConfig):
    powers: Mapping[int, float] = field(default_factory=lambda: {1: 2.0})


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        ("summary", {"frames": ["left/1.png"]}, "'left/1.png' can't be the name of a frame"),
        ("metadata", {"grid_size": 20, "far": 1e20}, r"the number 1e\+20"),
        ("metadata", {"grid_size": np.int64(20)}, "int64 is not JSON serializable"),
        ("initial_data", {"raw_density": np.full(1, np.nan)}, r"field\.grid has values that are not finite"),
        ("model", Unreadable(), "are read back as others"),
        ("model", ReadAsAnother(), "are read back as others"),
    ],
)
def test_what_a_run_could_not_be_opened_with_is_refused_before_it_is_trained(
    short_config, monkeypatch, part, value, words
):
    monkeypatch.setattr(f"tests.factories.rgb_nerf.BallDataManager.{part}", lambda _: value, raising=False)
    model = value if part == "model" else short_config.pipeline.model
    with pytest.raises(UnmixError, match=words):
        Trainer(replace(short_config, pipeline=replace(short_config.pipeline, model=model)))
    assert not short_config.output_dir.exists()


def test_a_run_whose_method_is_gone_is_refused(trained, registered):
    registered.clear()
    with pytest.raises(RunError, match="unknown method 'rgb-nerf'"):
        load_config(trained.path)


def test_nothing_is_written_when_the_scene_or_a_setting_is_refused(short_config, monkeypatch):
    def refuse(*_, **__):
        raise SceneError("no such scene")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.factories.rgb_nerf.BallDataManager.__init__", refuse)
        with pytest.raises(SceneError):
            Trainer(short_config)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for name, value, words in (
        ("device", "cuda", "--device cuda, but"),
        ("data", None, "folder with --data"),
    ):
        with pytest.raises(ConfigError, match=words):
            Trainer(replace(short_config, **{name: value}))
    assert not short_config.output_dir.exists()


def test_a_run_finds_its_scene_from_any_working_directory(short_config, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    trainer = Trainer(replace(short_config, data=Path("ball")))
    assert load_config(trainer.run.path).data == tmp_path / "ball"


@pytest.mark.parametrize(
    "name", ["/tmp/x", "../../x", "a/b", "..", ".", "", "a\nb", "a\0b", "\ud800", 3, None, "nul", "a:b", "a."]
)
def test_a_view_whose_name_is_no_plain_file_name_is_refused(trained, name):
    rewrite(trained.scene_path, lambda scene: scene["summary"].update(frames=["a", name]))
    with pytest.raises(RunError, match=r"scene\.json"):
        load_model(trained.path, "cpu")


@pytest.mark.parametrize("name", ["eval", "run.log", "checkpoints/extra", "exports/render"])
def test_a_link_that_leads_out_of_the_folder_is_refused(trained, name, tmp_path):
    link = trained.path / name
    link.unlink(missing_ok=True)
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(trained.scene_path)  # within the folder
    assert load_model(trained.path, "cpu").training.steps == 12
    link.unlink()
    link.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunError, match="link that leads out of the run folder"):
        load_model(trained.path, "cpu")


def test_exports_may_lie_on_a_larger_disk(trained, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    (trained.path / "exports").symlink_to(disk)
    assert load_model(trained.path, "cpu").training.steps == 12
    write_file(trained.path / "exports" / "a" / "b.txt", b"new")
    assert (disk / "a" / "b.txt").read_bytes() == b"new"
    (disk / "out").symlink_to(tmp_path)
    with pytest.raises(RunError, match="link that leads out of the run folder"):
        load_model(trained.path, "cpu")


def test_of_two_processes_that_write_a_file_at_once_each_writes_it_whole(tmp_path, monkeypatch):
    with ExitStack() as later:
        with whole_file(tmp_path / "out") as ours:
            ours.write_bytes(b"ours")
            monkeypatch.setattr(os, "getpid", lambda: 1)
            theirs = later.enter_context(whole_file(tmp_path / "out"))
            theirs.write_bytes(b"theirs, ha")
        assert (tmp_path / "out").read_bytes() == b"ours"
        theirs.write_bytes(b"theirs")
    assert (tmp_path / "out").read_bytes() == b"theirs"
    assert [path.name for path in tmp_path.glob("[!.]*")] == ["out"]


CHANGES: dict[str, Callable[[dict[str, Any]], object]] = {
    "no box": lambda scene: scene.pop("scene_box"),
    "box of text": lambda scene: scene.update(scene_box="big"),
    "box inside out": lambda scene: scene.update(scene_box=[[1, 1, 1], [0, 0, 0]]),
    "metadata a list": lambda scene: scene.update(metadata=[]),
    "no metadata": lambda scene: scene.update(metadata={}),
    "metadata of text": lambda scene: scene["metadata"].update(grid_size="x"),
    "another grid": lambda scene: scene["metadata"].update(grid_size=10),
    "summary null": lambda scene: scene.update(summary=None),
    "cameras ragged": lambda scene: scene["eval_cameras"]["camera_to_world"].append([1]),
    "too few lenses": lambda scene: scene["eval_cameras"]["focal_px"].pop(),
    "no width": lambda scene: scene["eval_cameras"].update(width=0),
    "huge": lambda scene: scene["eval_cameras"].update(height=10**12),
    "infinite lens": lambda scene: scene["eval_cameras"]["focal_px"].__setitem__(0, [1e60, 1e60]),
    "indices beyond": lambda scene: scene["summary"].update(frames=["a"], eval_indices=[0, 7]),
    "indices of text": lambda scene: scene["summary"].update(frames=["a", "b"], eval_indices=["0", "1"]),
    "frames of text": lambda scene: scene["summary"].update(frames="ab"),
    "frames of one name": lambda scene: scene["summary"].update(frames=["a", "a"]),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_scene_of_another_shape_is_refused(trained, name):
    rewrite(trained.scene_path, CHANGES[name])
    said = "does not fit the model that.*or train anew" if name == "another grid" else r"scene\.json"
    with pytest.raises(RunError, match=said):
        load_model(trained.path, "cpu")


@pytest.mark.parametrize("name", ["config.json", "scene.json"])
@pytest.mark.parametrize(
    "value", ["[" * 100 + "]" * 100, "[" * 200_000, "NaN", "1e999", '"\\u0000"', '"\\ud800"']
)
def test_json_that_no_run_writes_is_refused(trained, name, value):
    text = f'{{"format_version": {RUN_FORMAT}, "config": {value}, "scene_box": {value}}}'
    (trained.path / name).write_text(text)
    with pytest.raises(RunError, match=name):
        load_model(trained.path, "cpu")


@pytest.mark.parametrize(
    ("name", "value"),
    [("steps", "many"), ("steps", -1), ("num_rays", 0), ("learning_rates", 3), ("train_seconds", None)],
)
def test_a_record_of_another_shape_is_refused(trained, name, value):
    for record in trained.checkpoints.glob("*.json"):
        rewrite(record, lambda values: values.update({name: value}))
    with pytest.raises(RunError, match=name):
        load_model(trained.path, "cpu")


SCENE = {
    "wavelengths_nm": [450.0, 550.0, 650.0],
    "frames": ["left", "right"],
    "cameras": {"width": 64, "pose": [[[1.0, 0.0, 0.25], [0.0, 1.0, 4.0]]]},
    "light": None,
    "has_alpha": True,
}


def test_what_json_or_the_rounding_of_another_machine_change_is_no_difference():
    assert differences(SCENE, json.loads(json.dumps(SCENE))) == []
    assert differences({"box": (1, 2)}, {"box": [1.0, 2.0]}) == []
    pose = np.nextafter(np.array(SCENE["cameras"]["pose"]), 9.0)
    assert differences(SCENE, {**SCENE, "cameras": {"width": 64, "pose": pose.tolist()}}) == []


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"cameras": {"width": 65, "pose": SCENE["cameras"]["pose"]}}, "cameras.width"),
        ({"cameras": {"width": 64, "pose": [[[1.0, 0.0, 0.25], [0.0, 1.0, 4.01]]]}}, "cameras.pose"),
        ({"wavelengths_nm": [[450.0], [550.0, 650.0]]}, "wavelengths_nm"),
        ({"frames": ["left", "middle"]}, "frames"),
        ({"has_alpha": 1}, "has_alpha"),
        ({"files": {}}, "files"),
    ],
)
def test_anything_else_is_a_difference_and_is_named(change, named):
    assert differences(SCENE, {**SCENE, **change}) == [named]
    assert differences({**SCENE, **change}, SCENE) == [named]
