"""A method without spectra or endmembers gets every command that does not need them, without a change outside it."""

import json
import shutil
from pathlib import Path

import pytest

from tests.commands.running import done, refused
from tests.engine.conftest import registered, short_config, trained_once  # noqa: F401 (fixtures)
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.engine.configs import TrainerConfig


@pytest.fixture
def ball_run(short_config: TrainerConfig, trained_once: Path) -> Path:  # noqa: F811
    """A run of the plain RGB method."""
    return Path(shutil.copytree(trained_once, short_config.output_dir / "run"))


def test_it_is_rendered_and_evaluated_from_the_command_line(ball_run, tmp_path):
    done(render, "--run", ball_run, "--output", tmp_path / "out", "--outputs", "rgb", "--device", "cpu")
    assert len(list((tmp_path / "out" / "rgb").glob("*.png"))) == 2
    done(evaluate, "--run", ball_run, "--device", "cpu")
    figures = json.loads((ball_run / "eval" / "metrics.json").read_text())
    assert figures["views"] == 2
    assert figures["psnr"] > 3
    assert [image["name"] for image in figures["per_image"]] == ["eval_000", "eval_001"]
    assert (ball_run / "eval" / "rgb" / "eval_001.png").is_file()
    other = shutil.copytree(ball_run, tmp_path / "other")
    done(evaluate, ball_run, other, "--device", "cpu")
    assert (ball_run / "exports" / "comparison" / "rgb" / "eval_001.png").is_file()


def test_what_needs_endmembers_is_refused_in_one_sentence(ball_run, tmp_path):
    for words in (["abundances"], ["mesh"], ["endmembers"]):
        assert "the method rgb-nerf makes no scene of mixed materials" in refused(
            export, *words, "--run", ball_run, "--output", tmp_path / "out", "--device", "cpu"
        )
    refused(evaluate, "--run", ball_run, "--illuminant", "A", "--device", "cpu")


def test_another_environment_needs_a_method_that_knows_light_and_material_apart(ball_run, tmp_path):
    words = ["--run", ball_run, "--output", tmp_path / "out", "--device", "cpu"]
    said = refused(render, *words, "--environment", "studio")
    assert "the method rgb-nerf has no environment that could be exchanged" in said
    said = refused(render, *words, "--environment-rotation", "nan")
    assert "--environment-rotation is nan; give a finite number" in said
