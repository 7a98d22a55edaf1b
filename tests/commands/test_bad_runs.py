"""Run folders that no command can use: one message, exit code 2, nothing written."""

import json

import pytest
import torch

from tests.commands.running import run
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train

COMMANDS = [
    (evaluate, ["--run"]),
    (export, ["abundances", "--run"]),
    (export, ["endmembers", "--run"]),
    (export, ["segmentation", "--run"]),
    (render, ["--run"]),
    (train, ["unmix-nerf", "--load-run"]),
]


def removed(name):
    return lambda path: (path / name).unlink()


def cut_off(name):
    return lambda path: (path / name).write_bytes((path / name).read_bytes()[:40])


def newer(name):
    def change(path):
        values = json.loads((path / name).read_text())
        (path / name).write_text(json.dumps({**values, "format_version": 99}))

    return change


def in_scene(part, **changes):
    def change(path):
        values = json.loads((path / "scene.json").read_text())
        values[part].update(changes)
        (path / "scene.json").write_text(json.dumps(values))

    return change


def without_checkpoints(path):
    for file in (path / "checkpoints").iterdir():
        file.unlink()


SPOILT = {
    "missing config.json": (removed("config.json"), "config.json missing"),
    "missing scene.json": (removed("scene.json"), "scene.json missing"),
    "config.json cut off": (cut_off("config.json"), "can't read"),
    "scene.json cut off": (cut_off("scene.json"), "can't read"),
    "views outside": (
        in_scene("summary", frames=[f"../{i}" for i in range(8)]),
        "can't be the name of a frame",
    ),
    "grid of gigabytes": (in_scene("metadata", grid_resolution=1290), "a grid_resolution of 8 to 512"),
    "bands of text": (in_scene("metadata", wavelengths_nm=["red"]), "expected a number"),
    "root of no kind": (in_scene("summary", root=7), "expected text"),
    "newer config.json": (newer("config.json"), "written by a newer version"),
    "newer scene.json": (newer("scene.json"), "written by a newer version"),
    "newer checkpoint": (newer("checkpoints/step-000020.json"), "written by a newer version"),
    "tensors cut off": (cut_off("checkpoints/step-000020.safetensors"), "damaged or cut short"),
    "no checkpoint": (without_checkpoints, "no complete checkpoint"),
}


def contents(path):
    return {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}


@pytest.mark.parametrize("spoil", SPOILT)
def test_a_spoilt_run_folder_is_refused_by_every_command_and_left_alone(run_copy, spoil):
    change, said = SPOILT[spoil]
    change(run_copy)
    before = contents(run_copy)
    for command, words in COMMANDS:
        ended = run(command, *words, run_copy)
        assert ended.status == 2, (words, ended.err)
        assert said in ended.err
    after = contents(run_copy)
    after.pop(run_copy / "run.log")
    before.pop(run_copy / "run.log")
    assert after == before


@pytest.mark.parametrize(("command", "words"), COMMANDS)
def test_a_missing_run_folder_is_named(tmp_path, command, words):
    ended = run(command, *words, tmp_path / "none")
    assert ended.status == 2
    assert f"no run folder at {tmp_path / 'none'}" in ended.err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("command", "words"), COMMANDS)
def test_cuda_without_cuda_is_refused(run_copy, monkeypatch, command, words):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    ended = run(command, *words, run_copy, "--device", "cuda")
    assert ended.status == 2
    assert "--device cuda, but" in ended.err
