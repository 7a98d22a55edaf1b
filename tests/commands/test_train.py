"""`unmix-train`: the contract of its words, its last line, its exit codes, going on with a run, and its remarks."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unmix_plugin
from tests.factories.commands import SMALL_METHOD, done, refused, run, run_of
from tests.factories.cubes import full_disk
from unmix_plugin.commands.train import parse, train
from unmix_plugin.commands.training import remark_on_passes, remarks_on_course
from unmix_plugin.engine import registry
from unmix_plugin.engine.runs.loading import load_config, load_model
from unmix_plugin.engine.training.steps import TrainingSteps
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.library.spectra_csv import read_spectra


def small_training(trained, output_dir, *words):
    """Words that train on the tiny scene, with further ones."""
    return ["unmix-nerf", "--data", trained.scene, "--output-dir", output_dir, *SMALL_METHOD, *words]


def test_the_last_line_is_the_absolute_path_of_the_run_and_nothing_else(trained):
    assert trained.ended.last_line == f"run: {trained.run}"
    assert trained.run.is_absolute()
    assert trained.ended.out.endswith(f"run: {trained.run}\n")
    assert "\x1b" not in trained.ended.out
    assert trained.run.parent.parent.parent == trained.output_dir


def test_a_run_holds_its_settings_its_scene_a_checkpoint_and_its_endmembers(trained):
    stored = json.loads((trained.run / "config.json").read_text())["config"]
    assert (stored["max_num_iterations"], stored["device"]) == (20, "cpu")
    assert json.loads((trained.run / "training.json").read_text())["steps"] == 20
    assert (trained.run / "checkpoints" / "step-000020.safetensors").is_file()
    table = read_spectra(trained.run / "endmembers.csv")
    model: Any = load_model(trained.run, "cpu").model
    assert table.names == model.materials.called_by_colour().names
    np.testing.assert_allclose(table.spectra, model.endmembers.detach().numpy(), rtol=1e-6)
    np.testing.assert_allclose(table.bands.centers_nm, model.metadata["wavelengths_nm"], rtol=1e-8)


def test_explain_prints_what_a_training_would_decide_and_writes_nothing(trained, tmp_path):
    ended = done(train, *small_training(trained, tmp_path / "out", "--explain"))
    assert not (tmp_path / "out").exists()
    lines = ended.out.splitlines()
    [poses] = [number for number, line in enumerate(lines) if line.startswith("poses ")]
    table = lines[poses:]
    assert any("against" in line and "another convention" in line for line in table)
    assert any(line.startswith("light ") for line in table)
    assert any(line.endswith("--pipeline.model.light") for line in table)
    log = (trained.run / "run.log").read_text()
    assert all(line.rstrip() in log for line in table)  # a training keeps the same table


def test_explain_refuses_a_run_to_go_on_with(trained):
    said = refused(train, "unmix-nerf", "--load-run", trained.run, "--explain")
    assert "run.log" in str(said)


def test_words_work_right_after_the_method_and_common_settings_have_short_names(tmp_path):
    argv = f"unmix-nerf --data {tmp_path} --output-dir out --max-num-iterations 5 --max-seconds 7.5 --seed 3"
    argv += f" --endmembers 4 --endmember-init file --endmember-file {tmp_path} --value-scale 4095"
    config: Any = parse(f"{argv} --device cpu --invalid-pixels mask".split())[0]
    assert (config.data, config.output_dir, config.seed, config.device) == (tmp_path, Path("out"), 3, "cpu")
    assert (config.max_num_iterations, config.max_seconds) == (5, 7.5)
    model, scene = config.pipeline.model, config.pipeline.datamanager.scene
    assert (model.num_endmembers, model.endmember_init, model.endmember_file) == (4, "file", tmp_path)
    assert (scene.value_scale, scene.invalid_pixels) == (4095.0, "mask")
    for method, word in (("unmix-nerf", "--pipeline.model.num-endmembers"), ("neumatex", "--endmembers")):
        plain, four = parse([method])[0].pipeline.model, parse([method, word, "4"])[0].pipeline.model
        assert four == replace(plain, num_endmembers=4)


@pytest.mark.parametrize(
    ("words", "iterations", "seconds"),
    [
        ("", 10_000, None),
        ("--max-seconds 60", None, 60.0),
        ("--max-seconds=60", None, 60.0),
        ("--max_seconds 60", None, 60.0),
        ("--max-num-iterations 50", 50, None),
        ("--max-seconds 60 --max-num-iterations 50", 50, 60.0),
        ("--max-seconds None", 10_000, None),
    ],
)
def test_a_limit_given_alone_is_the_only_limit(words, iterations, seconds):
    config, _ = parse(["unmix-nerf", *words.split()])
    assert (config.max_num_iterations, config.max_seconds) == (iterations, seconds)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["unmix-nref", "--data", "demo"], "did you mean unmix-nerf or unmix-nerf-published?"),
        ([], "say which method to train first"),
        (["--data", "demo"], "say which method to train first"),
        (["unmix-nerf"], "give its folder with --data"),
        (["unmix-nerf", "--data", "no-such-folder"], "no-such-folder"),
        (["unmix-nerf", "--data", "demo", "--no-such-option"], "--no-such-option"),
        (["unmix-nerf", "--data", "demo", "--seed", "pi"], "seed"),
        (["unmix-nerf", "--data", "demo", "--max-seconds", "-1"], "max-seconds above 0"),
        (["unmix-nerf", "--data", "demo", "--pipeline.model.num-endmembers", "0"], "num-endmembers"),
    ],
)
def test_a_bad_word_exits_2_with_its_cause_and_writes_nothing(monkeypatch, tmp_path, words, said):
    monkeypatch.chdir(tmp_path)
    assert said in refused(train, *words)
    assert list(tmp_path.iterdir()) == []


def test_what_does_not_fit_the_scene_exits_2_and_writes_nothing(trained, tmp_path):
    words = small_training(trained, tmp_path / "out", "--pipeline.model.num-endmembers", 9)
    assert "num-endmembers is 9 but the scene has 8 bands" in refused(train, *words)
    assert not (tmp_path / "out").exists()


def test_a_broken_plugin_is_a_warning_and_the_others_go_on(monkeypatch):
    places = {"broken": "no_such_module:method", "unmix-nerf": "unmix_plugin.method_config:unmix_nerf"}
    entries = [EntryPoint(name, place, registry.METHOD_GROUP) for name, place in places.items()]
    monkeypatch.setattr(registry, "entry_points", lambda group: entries)  # noqa: ARG005
    ended = done(train, "--help")
    assert "warning: skipped the plugin broken: ModuleNotFoundError" in ended.err
    assert "  unmix-nerf  radiance field" in ended.out


def test_ctrl_c_saves_exits_130_and_says_how_to_go_on_which_then_works(trained, tmp_path, monkeypatch):
    take = TrainingSteps.take

    def interrupted_at_3(self, step, progress):
        if step == 3:
            signal.raise_signal(signal.SIGINT)
        return take(self, step, progress)

    monkeypatch.setattr(TrainingSteps, "take", interrupted_at_3)
    ended = run(train, *small_training(trained, tmp_path / "out", "--max-seconds", 1000))
    monkeypatch.undo()
    assert ended.status == 130
    path = run_of(ended)
    command = ended.err.splitlines()[-1].removeprefix("go on with: ").split()
    assert command == ["unmix-train", "unmix-nerf", "--load-run", str(path)]
    assert (path / "endmembers.csv").is_file()
    resumed = done(train, *command[1:], "--max-num-iterations", 6)
    assert resumed.last_line == f"run: {path}"
    assert json.loads((path / "training.json").read_text())["steps"] == 6


@pytest.mark.slow
def test_training_into_a_pipe_that_closes_saves_and_exits_141(trained, tmp_path):
    """As `unmix-train ... | head -2`."""
    argv = [str(word) for word in small_training(trained, tmp_path / "out", "--max-num-iterations", 10**6)]
    code = (
        "from unmix_plugin.engine.training.progress import ProgressDisplay\n"
        "ProgressDisplay.__init__.__defaults__ = (0.2, 0.2)  # seconds between lines\n"
        "from unmix_plugin.commands import scripts\nscripts.train()"
    )
    words = [sys.executable, "-c", code, *argv]
    process: Any
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        for _ in range(2):
            process.stdout.readline()
        process.stdout.close()
        said = process.stderr.read()
    assert process.returncode == 141, said
    (record,) = tmp_path.rglob("step-*.json")
    assert f"go on with: unmix-train unmix-nerf --load-run {record.parent.parent}" in said


def test_a_finished_run_without_a_larger_limit_says_that_there_is_nothing_to_train(run_copy):
    ended = done(train, "unmix-nerf", "--load-run", run_copy)
    assert "nothing to train: the run is at its limit, with 20 steps" in ended.out
    assert ended.last_line == f"run: {run_copy}"


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("model.endmember-init", "vca"),
        ("model.lamp", "0 0 0 0 0 0 1 0 0 1"),
        ("model.endmember-file", "a.csv"),
        # What the run's parameters mean follows from these.
        ("datamanager.scene.value-scale", "2"),
        ("model.field.cells-per-pixel", "1.71"),
        ("model.renderer.samples-per-pixel", "2"),
        ("model.renderer.coarse-samples", "9"),
        ("model.initial-opacity", "0.2"),
        ("model.losses.exposure", "2"),
    ],
)
def test_what_acts_at_the_start_alone_is_refused_where_a_run_goes_on(run_copy, flag, value):
    before = (run_copy / "config.json").read_bytes()
    more = {"model.lamp": ["--light", "camera"], "model.endmember-file": ["--endmember-init", "file"]}
    others = more.get(flag, [])
    words = [f"--pipeline.{flag}", *value.split(), *others, "--max-num-iterations", 21]
    said = refused(train, "unmix-nerf", "--load-run", run_copy, *words)
    named = "model.endmember-init" if flag == "model.endmember-file" else flag
    assert f"--pipeline.{named} is " in said
    assert "it acts when a run is started alone; leave it out, or start a new run" in said
    assert (run_copy / "config.json").read_bytes() == before


def test_a_run_goes_on_in_its_own_folder_alone(run_copy, tmp_path):
    words = [
        "unmix-nerf",
        "--load-run",
        run_copy,
        "--max-num-iterations",
        21,
        "--output-dir",
        tmp_path / "copy-of-it",
    ]
    assert "--output-dir is " in refused(train, *words)


def test_a_run_of_another_method_is_not_gone_on_with(run_copy):
    with pytest.raises(ConfigError, match="is a run of unmix-nerf, not of neumatex"):
        parse(["neumatex", "--load-run", str(run_copy)])


def test_a_full_disk_while_saving_exits_2_and_says_so(trained, tmp_path, monkeypatch):
    def full_from_the_first_step(*args):
        full_disk(monkeypatch, after=0)
        return take(*args)

    take = TrainingSteps.take
    monkeypatch.setattr(TrainingSteps, "take", full_from_the_first_step)
    words = small_training(trained, tmp_path / "out", "--max-num-iterations", 2)
    assert "No space left on device" in refused(train, *words)
    assert not list(tmp_path.rglob("*.tmp"))
    assert not list(tmp_path.rglob("step-*"))


def test_training_from_python_takes_the_names_of_flags_and_gives_a_scene(trained, tmp_path, capsys):
    small = {name.lstrip("-"): value for name, value in (word.split("=") for word in SMALL_METHOD)}
    numbers = {name: json.loads(value) for name, value in small.items() if name != "device"}
    given = {"endmembers": 3, "max_num_iterations": np.int64(5), "device": "cpu", **numbers}
    scene = unmix_plugin.train(trained.scene, output_dir=tmp_path, **given)
    assert isinstance(scene, unmix_plugin.TrainedScene)
    path = Path(capsys.readouterr().out.splitlines()[-1].removeprefix("run: "))
    words = [f"--{name}={value}" for name, value in given.items()]
    words = ["unmix-nerf", "--data", str(trained.scene), "--output-dir", str(tmp_path), *words]
    config = load_config(path)
    assert config == replace(parse(words)[0], load_run=path, pipeline=config.pipeline)
    assert len(scene.materials.names) == 3
    again = unmix_plugin.train(None, load_run=path, max_num_iterations=6)
    assert isinstance(again, unmix_plugin.TrainedScene)
    assert json.loads((path / "training.json").read_text())["steps"] == 6


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"endmember": 3}, "unmix-nerf has no setting endmember; did you mean endmembers"),
        ({"num_endmembers": 3}, "has no setting num_endmembers; did you mean endmembers?"),
        ({"pipeline.model.loses.rgb": 1}, "did you mean pipeline.model.losses.rgb"),
        ({"qqq": 1}, "has no setting qqq; unmix-train unmix-nerf --help-all lists all"),
        ({"endmembers": 3, "pipeline.model.num-endmembers": 3}, "are the same setting: give one"),
        ({"endmembers": "six"}, "num_endmembers: expected int or 'auto' or None, found 'six'"),
        ({"max_seconds": -1}, "max-seconds above 0"),
        ({"seed": object()}, "seed: a config holds a object"),
        ({"data": "other"}, "the scene is demo, and data is other"),
        ({"machine.num-devices": 2}, "one Python process trains on one device"),
    ],
)
def test_training_from_python_refuses_a_setting_in_one_message(monkeypatch, tmp_path, settings, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as refused:
        unmix_plugin.train("demo", **settings)
    assert said in str(refused.value)
    assert not list(tmp_path.iterdir())


def remarks_on(folder, *quarters: float | None, kept=slice(None), **last) -> list[str]:
    """On five lines a quarter of a training, around a loss each, one batch far off."""
    losses = [loss and loss * (10 if row == 2 else 1) for loss in quarters for row in range(5)]
    lines = [{"step": 50 * n, "loss": loss, "split": "train"} for n, loss in enumerate(losses, start=1)]
    lines = [*lines[:-1], {**lines[-1], **last}][kept]
    lines += [{"step": 1000, "split": "eval_all", "psnr": 20.0}]
    (folder / "metrics.jsonl").write_text("\n".join(json.dumps(line) for line in lines) + "\n")
    return remarks_on_course(folder / "metrics.jsonl")


SETTLED = (1.0, 0.4, 0.2, 0.16)
HARDLY_FELL = (1.0, 0.9, 0.85, 0.8)


@pytest.mark.parametrize(
    ("quarters", "last", "said"),
    [
        (SETTLED, {}, None),
        (HARDLY_FELL, {}, "hardly fell: in the last quarter of the training it was 80%"),
        ((1.0, 0.6, 0.4, 0.2), {}, "still fell by 50%"),
        (SETTLED, {"poses_undone": 0.0, "pose_outliers": 0.01, "matter_share": 0.3}, None),
        (SETTLED, {"poses_undone": 3.0}, "3 views went beyond a quarter of the distance to the scene or too"),
        (SETTLED, {"pose_outliers": 0.12}, "12% of the views, or of the rows of line cameras, still fit far"),
        (SETTLED, {"matter_share": 0.01}, "99% of what the views show was learnt as sky"),
    ],
)
def test_what_a_training_did_not_reach_is_remarked(tmp_path, quarters, last, said):
    found = remarks_on(tmp_path, *quarters, **last)
    assert len(found) == (said is not None)
    assert said is None or said in found[0]


def test_few_rays_a_pixel_are_remarked_and_losses_that_say_nothing_are_not(tmp_path):
    assert "0.8 rays for each training pixel" in remark_on_passes(80_000, 100_000)[0]
    assert remark_on_passes(900_000, 100_000) == remark_on_passes(80_000, 0) == []
    assert remarks_on(tmp_path, *HARDLY_FELL, kept=slice(-5, None)) == remarks_on(tmp_path, *4 * [None]) == []
    (tmp_path / "cut.jsonl").write_text('{"step": 1')
    assert remarks_on_course(tmp_path / "cut.jsonl") == remarks_on_course(tmp_path / "missing.jsonl") == []
