"""Run folders: made once each, found again, refused when unusable."""

import json
import os
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import pytest
import torch

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.runs.atomic_files import RUN_FORMAT, write_run_json
from unmix_plugin.engine.runs.checkpoints import save_checkpoint
from unmix_plugin.engine.runs.load_run import load_config, load_model, load_pipeline
from unmix_plugin.engine.runs.run_folder import RunFolder, create_run_folder, newest_run, open_run_folder
from unmix_plugin.engine.runs.scene_record import read_scene_record
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.errors import ConfigError, RunError, SceneError

NOON = datetime(2024, 5, 6, 12, 0, 7, tzinfo=timezone.utc)


def complete_run(output_dir: Path, started: datetime, scene: str = "s", checkpoint: bool = True) -> RunFolder:
    run = create_run_folder(output_dir, scene, "m", started)
    for path in (run.config_path, run.scene_path):
        write_run_json(path, {})
    if checkpoint:
        save_checkpoint(run.checkpoints, 1, {"a": torch.zeros(1)}, {})
    return run


def test_a_run_is_named_for_scene_method_and_second(tmp_path: Path):
    run = create_run_folder(tmp_path, "pots", "unmix", NOON)
    assert run.path == tmp_path / "pots" / "unmix" / "2024-05-06_120007"
    assert run.path.is_dir()


def test_runs_started_in_the_same_second_get_folders_of_their_own(tmp_path: Path):
    paths = {create_run_folder(tmp_path, "pots", "unmix", NOON).path for _ in range(12)}
    assert len(paths) == 12


def test_a_scene_name_that_is_no_file_name_stays_inside_the_output_folder(tmp_path: Path):
    for name in ("..", "a/b", "", ".", "x y\n"):
        run = create_run_folder(tmp_path, name, "m", NOON)
        assert run.path.parents[2] == tmp_path


def test_the_newest_run_is_the_one_started_or_resumed_last_whatever_its_name(tmp_path: Path):
    runs = [
        complete_run(tmp_path, NOON.replace(year=year), scene, checkpoint)
        for year, scene, checkpoint in (
            (2099, "a", True),
            (2026, "b", True),
            (2024, "c", True),
            (2027, "d", False),
        )
    ]
    for second, run in enumerate(runs):
        os.utime(run.config_path, (second, second))
    (tmp_path / "a" / "m" / "notes").mkdir()
    assert newest_run(tmp_path) == runs[2]
    os.utime(runs[1].config_path, (9, 9))
    assert newest_run(tmp_path) == runs[1]


def test_no_run_at_all_is_said(tmp_path: Path):
    with pytest.raises(RunError, match="no run with a checkpoint under"):
        newest_run(tmp_path / "nothing")


def test_an_output_folder_that_is_a_file_is_refused(tmp_path: Path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(RunError, match="choose another --output-dir"):
        create_run_folder(tmp_path / "file", "s", "m")


def test_a_missing_folder_is_refused(tmp_path: Path):
    for load in (open_run_folder, load_config, load_model, load_pipeline):
        with pytest.raises(RunError, match="no run folder at"):
            load(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["config.json", "scene.json"])
def test_a_half_written_folder_is_refused(trained: RunFolder, name: str):
    (trained.path / name).unlink()
    with pytest.raises(RunError, match=f"half-written one: {name} missing"):
        load_model(trained.path)


@pytest.mark.parametrize("name", ["config.json", "scene.json"])
@pytest.mark.parametrize("text", ["", '{"format_version": 1, "con', "[]", "{}"])
def test_a_cut_off_or_foreign_file_is_refused(trained: RunFolder, name: str, text: str):
    (trained.path / name).write_text(text)
    with pytest.raises(RunError, match=name):
        load_model(trained.path)


@pytest.mark.parametrize("name", ["config.json", "scene.json", "checkpoints/step-000012.json"])
@pytest.mark.parametrize(
    ("version", "message"),
    [
        (99, r"format 99, written by a newer version.*update this package"),
        (RUN_FORMAT - 1, rf"format {RUN_FORMAT - 1}, written by an older version.*train again"),
    ],
)
def test_another_version_is_refused_with_what_to_do(
    trained: RunFolder, name: str, version: int, message: str
):
    path = trained.path / name
    path.write_text(json.dumps({**json.loads(path.read_text()), "format_version": version}))
    with pytest.raises(RunError, match=message):
        load_model(trained.path)


def test_a_run_without_a_checkpoint_is_refused(trained: RunFolder):
    for path in trained.checkpoints.iterdir():
        path.unlink()
    with pytest.raises(RunError, match="no complete checkpoint"):
        load_model(trained.path)


def test_a_config_that_does_not_fit_the_method_is_refused_by_field(trained: RunFolder):
    values = json.loads(trained.config_path.read_text())
    values["config"]["pipeline"]["model"]["num_samples_per_ray"] = "many"
    trained.config_path.write_text(json.dumps(values))
    with pytest.raises(RunError, match=r"config\.pipeline\.model\.num_samples_per_ray: expected an integer"):
        load_model(trained.path)


def test_a_run_of_a_method_that_is_not_installed_is_refused(trained: RunFolder, registered: list):
    registered.clear()
    with pytest.raises(RunError, match="unknown method 'rgb-nerf'"):
        load_config(trained.path)


def test_nothing_is_written_when_the_scene_or_a_setting_is_refused(short_config: TrainerConfig, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise SceneError("no such scene")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.engine.rgb_nerf_plugin.BallDataManager.__init__", refuse)
        with pytest.raises(SceneError):
            Trainer(short_config)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    for changes, words in (
        ({"device": "cuda"}, "--device cuda, but"),
        ({"data": None}, "give its folder with --data"),
    ):
        with pytest.raises(ConfigError, match=words):
            Trainer(replace(short_config, **changes))
    assert not short_config.output_dir.exists()


def test_the_scene_record_holds_box_cameras_and_metadata_to_the_bit(
    trained: RunFolder, short_config: TrainerConfig
):
    scene = read_scene_record(trained)
    datamanager = Trainer(short_config).pipeline.datamanager
    assert torch.equal(scene.scene_box.aabb, datamanager.scene_box.aabb)
    assert torch.equal(scene.eval_cameras.camera_to_world, datamanager.eval_cameras.camera_to_world)
    assert scene.metadata == {"grid_size": 20}


def test_a_run_finds_its_scene_from_any_working_directory(
    short_config: TrainerConfig, monkeypatch, tmp_path: Path
):
    monkeypatch.chdir(tmp_path)
    trainer = Trainer(replace(short_config, data=Path("ball")))
    assert load_config(trainer.run.path).data == tmp_path / "ball"
