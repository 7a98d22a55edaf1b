"""The notebooks: small, their code and commands parse, and one of them runs. The example of a training loop trains."""

import importlib
import json
import re
import shlex
import sys

import pytest

from scripts.stage_site import parser_of
from tests.factories.pages import ROOT
from unmix_plugin.engine import find_method
from unmix_plugin.scenes.demo.scene import demo_scene_path

TUTORIALS = ROOT / "docs/tutorials"
NAMES = sorted(path.stem for path in TUTORIALS.glob("*.ipynb"))


def cells(name):
    notebook = json.loads((TUTORIALS / f"{name}.ipynb").read_text(encoding="utf-8"))
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


@pytest.mark.parametrize("name", NAMES)
def test_their_code_and_their_commands_parse(name):
    for cell in cells(name):
        lines = "".join(cell["source"]).splitlines()
        for line in [line for line in lines if line.startswith("!")]:
            command, *words = shlex.split(line[1:])
            parser, rest = parser_of(command, words)
            parser.parse_args(rest)
        code = "\n".join(line for line in lines if not line.startswith("!"))
        compile(code, f"{name}: {cell['id']}", "exec")


def test_they_are_small_and_name_no_place_of_the_machine_that_ran_them():
    assert sum((TUTORIALS / f"{name}.ipynb").stat().st_size for name in NAMES) < 1_000_000
    for name in NAMES:
        outputs = [output for cell in cells(name) for output in cell["outputs"]]
        text = "".join("".join(output.get("text", "")) for output in outputs)
        assert not re.search(r"Traceback|\x1b|/tmp/|/home/", text), name


@pytest.mark.slow
def test_the_painting_runs():
    pytest.importorskip("nbclient")
    from scripts.run_notebooks import run

    notebook = run("painting", seconds=2)
    pictures = [output for cell in notebook.cells for output in cell.get("outputs", []) if "data" in output]
    assert len(pictures) == 5


@pytest.mark.slow
def test_the_example_of_a_training_loop_trains(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    try:
        simple_trainer = importlib.import_module("simple_trainer")
        metrics = simple_trainer.train(find_method("unmix-nerf").config, demo_scene_path(), num_steps=100)
    finally:
        sys.modules.pop("simple_trainer", None)
    assert metrics["psnr"] > 19.5  # 20.6 to 23.1 dB
