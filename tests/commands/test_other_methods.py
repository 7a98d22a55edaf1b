"""A method without spectra or endmembers gets every command that does not need them, without a change outside it."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.commands.running import run
from tests.engine.conftest import registered, short_config, trained_once  # noqa: F401 (fixtures)
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.open_run import load_run, open_run
from unmix_plugin.trained.protocol import RenderableScene


@pytest.fixture
def ball_run(short_config: TrainerConfig, trained_once: Path) -> Path:  # noqa: F811
    """A run of the plain RGB method."""
    return Path(shutil.copytree(trained_once, short_config.output_dir / "run"))


def test_its_run_opens_as_a_scene_with_the_outputs_that_it_names(ball_run):
    scene = load_run(ball_run, "cpu").scene
    assert isinstance(scene, RenderableScene)
    assert [output.name for output in scene.outputs] == ["rgb", "accumulation"]
    camera = scene.views[0].camera
    picture = scene.render(camera, ["rgb"])["rgb"]
    found = scene.probe(camera, 9, 11)
    np.testing.assert_allclose(found.values["rgb"], picture[11, 9], atol=1e-6)
    with pytest.raises(ConfigError, match=r"no output named 'rbg' \(did you mean rgb\?\); known are rgb"):
        scene.render(camera, ["rbg"])
    with pytest.raises(ConfigError, match="the method rgb-nerf makes no scene of mixed materials"):
        open_run(ball_run, "cpu")


def test_it_is_rendered_and_evaluated_from_the_command_line(ball_run, tmp_path):
    ended = run(
        render, "--run", ball_run, "--output", tmp_path / "out", "--outputs", "rgb", "--device", "cpu"
    )
    assert ended.status == 0, ended.err
    assert len(list((tmp_path / "out" / "rgb").glob("*.png"))) == 2
    ended = run(evaluate, "--run", ball_run, "--device", "cpu")
    assert ended.status == 0, ended.err
    figures = json.loads((ball_run / "eval" / "metrics.json").read_text())
    assert figures["views"] == 2
    assert figures["psnr"] > 3
    assert [image["name"] for image in figures["per_image"]] == ["eval_000", "eval_001"]
    assert (ball_run / "eval" / "rgb" / "eval_001.png").is_file()
    other = shutil.copytree(ball_run, tmp_path / "other")
    ended = run(evaluate, ball_run, other, "--device", "cpu")
    assert ended.status == 0, ended.err
    assert (ball_run / "exports" / "comparison" / "rgb" / "eval_001.png").is_file()


def test_what_needs_endmembers_is_refused_in_one_sentence(ball_run, tmp_path):
    for words in (["abundances"], ["mesh"], ["endmembers"]):
        ended = run(export, *words, "--run", ball_run, "--output", tmp_path / "out", "--device", "cpu")
        assert ended.status == 2
        assert "the method rgb-nerf makes no scene of mixed materials" in " ".join(ended.err.split())
    ended = run(evaluate, "--run", ball_run, "--illuminant", "A", "--device", "cpu")
    assert ended.status == 2


def test_another_environment_needs_a_method_that_knows_light_and_material_apart(ball_run, tmp_path):
    words = ["--run", ball_run, "--output", tmp_path / "out", "--device", "cpu"]
    ended = run(render, *words, "--environment", "studio")
    assert ended.status == 2
    assert "the method rgb-nerf has no environment that could be exchanged" in " ".join(ended.err.split())
    ended = run(render, *words, "--environment-rotation", "nan")
    assert ended.status == 2
    assert "--environment-rotation is nan; give a finite number" in " ".join(ended.err.split())
