"""Run folders that no command can use: one message, exit code 2, nothing written."""

import hashlib
import json
import os
import re

import pytest
import safetensors.torch
import torch

from tests.factories.commands import done, refused
from tests.factories.cubes import full_disk
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.commands.view import view
from unmix_plugin.engine.runs.replacing import LIST_NAME

COMMANDS = [(evaluate, ["--run"]), (export, ["abundances", "--run"]), (render, ["--run"])]
COMMANDS += [(train, ["unmix-nerf", "--load-run"]), (view, ["--run"])]


def cut_off(name):
    return lambda path: (path / name).write_bytes((path / name).read_bytes()[:40])


def in_json(name, part=None, **changes):
    def change(path):
        values = json.loads((path / name).read_text())
        (values if part is None else values[part]).update(changes)
        (path / name).write_text(json.dumps(values))

    return change


def in_scene(part, **changes):
    return in_json("scene.json", part, **changes)


def spoilt_tensors(value):
    """One parameter of the newest checkpoint is that number, with the right hash as only malice makes it."""

    def change(path):
        tensors_path = path / "checkpoints" / "step-000020.safetensors"
        tensors = safetensors.torch.load(tensors_path.read_bytes())
        for name, tensor in tensors.items():
            if name.startswith(("model/", "average/")) and tensor.is_floating_point() and "peak" not in name:
                tensor.view(-1)[:1] = value
        data = safetensors.torch.save(tensors)
        tensors_path.write_bytes(data)
        in_json("checkpoints/step-000020.json", sha256=hashlib.sha256(data).hexdigest())(path)

    return change


def piped(name):
    """A pipe that nobody writes to, in place of a file."""

    def change(path):
        if not hasattr(os, "mkfifo"):
            pytest.skip("needs what only POSIX has")
        (path / name).unlink()
        os.mkfifo(path / name)

    return change


SPOILT = {
    "settings of an old version": (in_json("config.json", format_version=5), "format 5, written by an older"),
    "tensors of NaN": (spoilt_tensors(float("nan")), "has values that are not finite"),
    "tensors of infinity": (spoilt_tensors(float("inf")), "has values that are not finite"),
    "tensors cut off": (cut_off("checkpoints/step-000020.safetensors"), "damaged or cut short"),
    "piped config.json": (piped("config.json"), "config.json missing"),
    "piped checkpoint": (piped("checkpoints/step-000020.json"), "is no regular file"),
    "piped tensors": (piped("checkpoints/step-000020.safetensors"), "is no regular file"),
    "light beyond numbers": (in_scene("metadata", illuminant=[1e308] * 8), "the number 1e+308"),
    "world of no size": (
        in_scene("metadata", pixel_size=1e-300),
        "Expected `float` > 1e-12 - at `$.pixel_size`",
    ),
    "circle of links": (lambda path: (path / "notes").symlink_to("notes"), "can't open the run folder"),
    "scene.json cut off": (cut_off("scene.json"), "is not valid JSON"),
    "views outside": (in_scene("summary", frames=[f"../{i}" for i in range(8)]), "the name of a frame"),
    "another grid": (
        in_scene("metadata", grid_resolution=512),
        "grid_resolution",
    ),
    "grid of gigabytes": (
        in_scene("metadata", grid_resolution=1290),
        "Expected `int` <= 512 - at `$.grid_resolution`",
    ),
    "bands of text": (
        in_scene("metadata", wavelengths_nm=["red"]),
        "Expected `float`, got `str` - at `$.wavelengths_nm[0]`",
    ),
    "root of no kind": (in_scene("summary", root=7), "Expected `str`, got `int` - at `$.root`"),
}

BY_EVERY_COMMAND = ("settings of an old version", "tensors of NaN", "scene.json cut off", "circle of links")
ON_EACH_WAY = [one for one in COMMANDS if one[0] in (evaluate, train)]
"""To look at a run, as all commands but one open it, and to go on with it."""


def contents(path):
    return {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


@pytest.mark.parametrize("spoil", SPOILT)
def test_a_spoilt_run_folder_is_refused_and_left_alone(run_copy, spoil):
    change, said = SPOILT[spoil]
    change(run_copy)
    before = contents(run_copy)
    for command, words in COMMANDS if spoil in BY_EVERY_COMMAND else ON_EACH_WAY:
        assert said in refused(command, *words, run_copy)
    after = contents(run_copy)
    after.pop(run_copy / "run.log")
    before.pop(run_copy / "run.log")
    assert after == before


@pytest.mark.parametrize(("command", "words"), COMMANDS)
def test_a_run_folder_or_a_device_that_is_not_there_is_named(run_copy, tmp_path, monkeypatch, command, words):
    assert f"no run folder at {tmp_path / 'none'}" in refused(command, *words, tmp_path / "none")
    assert "too long" in refused(command, *words, tmp_path / ("x" * 300))
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "--device cuda, but" in refused(command, *words, run_copy, "--device", "cuda")


@pytest.mark.parametrize(
    ("command", "words", "file", "after"),
    [
        (evaluate, ["--run"], r"rgb/eval_002\.png", 0),
        (export, ["abundances", "--output", "out", "--run"], r"out/eval_002\.npy", 0),
        (render, ["--output", "out", "--formats", "npy", "--run"], r"out/spectral/eval_002\.npy", 6000),
    ],
)
def test_a_full_disk_exits_2_says_where_and_leaves_whole_files_only(
    run_copy, tmp_path, monkeypatch, command, words, file, after
):
    monkeypatch.chdir(tmp_path)
    before = set(contents(run_copy))
    full_disk(monkeypatch, after)
    said = refused(command, *words, run_copy)
    assert re.search(rf"can't write \S*{file}: No space left on device; make room", said)
    assert "--load-run" not in said
    left = [*contents(tmp_path / "out"), *(set(contents(run_copy)) - before)]
    assert {path.name for path in left} <= {"cameras-dataset-eval.json", "run.log", LIST_NAME}


NO_FIGURES = ['{"psnr": 1' + "0" * 400 + "}", '{"psnr": "high"}', '{"psnr": NaN}']
NO_FIGURES += ["\udcff", "[" * 60 + "]" * 60, "[]"]


@pytest.mark.parametrize("found", NO_FIGURES)
def test_figures_that_no_evaluation_wrote_are_refused_by_the_report(run_copy, found):
    (run_copy / "eval").mkdir(exist_ok=True)
    (run_copy / "eval" / "metrics.json").write_text(found, encoding="utf-8", errors="surrogateescape")
    assert "metrics.json" in refused(export, "report", "--run", run_copy)


@pytest.mark.parametrize(
    ("change", "command", "words", "said"),
    [
        (piped("metrics.jsonl"), train, ["unmix-nerf", "--load-run"], "is no regular file"),
        (piped("run.log"), train, ["unmix-nerf", "--load-run"], "run.log"),
        (in_scene("eval_cameras", width=32), evaluate, ["--run"], "is not the one that"),
    ],
)
def test_what_lies_beside_config_and_scene_is_read_with_the_same_care(run_copy, change, command, words, said):
    change(run_copy)
    assert said in refused(command, *words, run_copy)


def test_lines_of_metrics_that_no_training_wrote_are_passed_over(run_copy):
    with (run_copy / "metrics.jsonl").open("ab") as file:
        for line in (b"\xff", b"[" * 9000, b'{"step": 1' + b"0" * 400 + b"}", b'{"step": "x"}', b"{}", b"3"):
            file.write(line + b"\n")
    done(export, "report", "--run", run_copy)


def test_names_that_are_no_step_are_no_checkpoints(run_copy):
    for name in ("step-².json", "step-٣.json", "step-.json"):
        (run_copy / "checkpoints" / name).write_text("{}", encoding="utf-8")
    done(export, "endmembers", "--run", run_copy)
