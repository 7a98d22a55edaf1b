"""A method without spectra or endmembers gets every command that does not need them, without a change outside it."""

import json
import re
import shutil
from pathlib import Path

import pytest

from tests.engine.conftest import (  # noqa: F401 (fixtures)
    RGB_NERF_ENTRY,
    registered,
    short_config,
    trained_once,
)
from tests.factories.commands import done, refused, run
from tests.factories.rgb_nerf import RgbNerf, RgbNerfConfig
from unmix_plugin.commands.compare import compare
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.engine import registry
from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.model import Model


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
    assert "makes no scene of mixed materials" in refused(compare, ball_run, ball_run, "--device", "cpu")
    refused(evaluate, "--run", ball_run, "--illuminant", "A", "--device", "cpu")


def test_another_environment_needs_a_method_that_knows_light_and_material_apart(ball_run, tmp_path):
    words = ["--run", ball_run, "--output", tmp_path / "out", "--device", "cpu"]
    said = refused(render, *words, "--environment", "studio")
    assert "the method rgb-nerf has no environment that could be exchanged" in said
    said = refused(render, *words, "--environment-rotation", "nan")
    assert "--environment-rotation is nan; give a finite number" in said


class _LossIsNoTensor(RgbNerf):
    def get_loss_dict(self, outputs, batch, metrics_dict=None):  # pyright: ignore[reportIncompatibleMethodOverride]
        return {"rgb": 0.5}


class _LossOfManyNumbers(RgbNerf):
    def get_loss_dict(self, outputs, batch, metrics_dict=None):
        return {"rgb": (outputs["rgb"] - batch["rgb"]).square()}


class _WrongShape(RgbNerf):
    def get_loss_dict(self, outputs, batch, metrics_dict=None):
        return {"rgb": (outputs["rgb"][:, :2] - batch["rgb"]).square().mean()}


class _OtherArguments(RgbNerf):
    def get_loss_dict(self, outputs):  # pyright: ignore[reportIncompatibleMethodOverride]
        return {"rgb": outputs["rgb"].mean()}


class _NoLosses(Model):
    def populate_modules(self):
        pass


@pytest.mark.parametrize(
    ("kind", "status", "said"),
    [
        (
            _LossIsNoTensor,
            2,
            r"the loss rgb of .*_LossIsNoTensor \(.*test_other_methods\.py:\d+\) is a float",
        ),
        (
            _LossOfManyNumbers,
            2,
            r"_LossOfManyNumbers \(.*:\d+\) is a tensor of the shape \(\d+, 3\); expected a tensor",
        ),
        (
            _WrongShape,
            1,
            r"error in the plugin tests \(.*test_other_methods\.py:\d+, in get_loss_dict\): RuntimeError",
        ),
        (_OtherArguments, 1, r"plugin tests \(.*_OtherArguments \(.*:\d+\)\): TypeError: .*get_loss_dict"),
        (_NoLosses, 2, r"_NoLosses \(.*:\d+\) has no get_image_metrics_and_images and no .*get_param_groups"),
    ],
)
def test_faults_of_a_plugins_own_code_are_said_to_be_its_own(tmp_path, monkeypatch, kind, status, said):
    monkeypatch.setattr(registry, "entry_points", lambda group: [RGB_NERF_ENTRY] if group else [])
    monkeypatch.setattr(RgbNerfConfig, "target", property(lambda _: kind))
    (tmp_path / "ball").mkdir()
    words = [
        "--data",
        tmp_path / "ball",
        "--output-dir",
        tmp_path,
        "--device",
        "cpu",
        "--max-num-iterations",
        2,
    ]
    ended = run(train, "rgb-nerf", *words)
    assert ended.status == status
    assert re.search(said, ended.err), ended.err
    assert "bug in unmix-nerf" not in ended.err
