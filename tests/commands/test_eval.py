"""`unmix-eval`: the keys of metrics.json, what is drawn, what edits change, and what is refused."""

import json
import math
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.factories.commands import done, picture_size, refused
from tests.factories.runs import small_run
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.render import render
from unmix_plugin.commands.view import view
from unmix_plugin.engine.processes import ALONE
from unmix_plugin.engine.runs.loading import load_pipeline
from unmix_plugin.products.evaluation import evaluate_scene
from unmix_plugin.products.product import Job
from unmix_plugin.products.report.report import compared_views
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.metrics import psnr
from unmix_plugin.trained.evaluation import DEFINITIONS
from unmix_plugin.trained.open_run import load_run

KEYS = list(DEFINITIONS)


@pytest.fixture(scope="module")
def evaluated(trained, tmp_path_factory):
    """A copy of the trained run, evaluated, and what was printed."""
    path = Path(shutil.copytree(trained.run, tmp_path_factory.mktemp("evaluated") / "run"))
    ended = done(evaluate, "--run", path, "--device", "cpu")
    return path, ended


def test_metrics_have_exactly_the_keys_of_the_contract_all_known_where_there_is_truth(evaluated):
    figures = metrics(evaluated[0] / "eval")
    assert list(figures) == [*KEYS, "per_view", "definitions"]
    assert list(figures["definitions"]) == KEYS
    contract = """psnr psnr_matter psnr_unsaturated psnr_matter_unsaturated psnr_white rmse ssim sam rgb_psnr miou
        macro_f1 accuracy abundance_rmse endmember_angle views bands train_seconds train_rays_per_second"""
    assert contract.split() == KEYS
    assert all(math.isfinite(figures[key]) for key in KEYS)
    assert (figures["views"], figures["bands"]) == (2, 8)
    training = json.loads((evaluated[0] / "training.json").read_text())
    assert figures["train_seconds"] == training["train_seconds"]


def test_figures_are_means_over_the_views_of_what_the_model_renders(evaluated):
    path, _ = evaluated
    figures = metrics(path / "eval")
    loaded = load_pipeline(path, "cpu")
    datamanager: Any = loaded.pipeline.datamanager
    scene = datamanager.scene
    expected = []
    for index in scene.eval_indices:
        predicted = loaded.pipeline.model.get_outputs_for_camera(scene.cameras[index])["spectral"]
        expected.append(psnr(predicted, torch.from_numpy(scene.cube(index))))
    assert [view["psnr"] for view in figures["per_view"]] == pytest.approx(expected, rel=1e-6)
    assert figures["psnr"] == pytest.approx(sum(expected) / 2, rel=1e-6)
    names = [scene.frames[index].name for index in scene.eval_indices]
    assert [view["name"] for view in figures["per_view"]] == names


def test_each_view_gets_three_pictures_and_all_that_was_written_is_named(evaluated):
    path, ended = evaluated
    for kind in ("rgb", "segmentation", "abundances"):
        pictures = sorted((path / "eval" / kind).glob("[!.]*"))
        assert [picture.name for picture in pictures] == ["eval_002.png", "eval_006.png"]
        for picture in pictures:
            assert min(picture_size(picture)) > 200
    assert str(path / "eval" / "metrics.json") in ended.out
    assert "6 pictures" in ended.out
    for key in KEYS:
        assert key in ended.out


def test_what_has_no_truth_is_null(trained, run_copy, tmp_path):
    scene = Path(shutil.copytree(trained.scene, tmp_path / "untold"))
    content = json.loads((scene / "transforms.json").read_text())
    content = {key: value for key, value in content.items() if key not in ("materials", "endmembers_path")}
    for frame in content["frames"]:
        for key in ("seg_file_path", "abundance_file_path"):
            frame.pop(key, None)
    (scene / "transforms.json").write_text(json.dumps(content))
    done(evaluate, "--run", run_copy, "--data", scene, "--device", "cpu")
    figures = metrics(run_copy / "eval")
    unknown = {"miou", "macro_f1", "accuracy", "abundance_rmse", "endmember_angle"}
    assert {key for key in KEYS if figures[key] is None} == unknown
    assert len(list((run_copy / "eval").rglob("*.png"))) == 6


def test_without_run_the_newest_is_evaluated_and_named(run_copy, monkeypatch):
    monkeypatch.chdir(run_copy.parents[3])
    older = run_copy.with_name("2001-01-01_000000")
    shutil.copytree(run_copy, older)
    ended = done(evaluate, "--output-dir", "copy")
    assert ended.out.splitlines()[0] == f"newest run: {run_copy}"
    assert (run_copy / "eval" / "metrics.json").is_file()
    assert not (older / "eval").exists()
    assert "no run with a checkpoint" in refused(evaluate, "--output-dir", older)


@pytest.mark.parametrize("name", ["figures", "outputs"])
@pytest.mark.parametrize("command", [evaluate, export, render, view])
def test_a_folder_to_look_for_runs_is_refused_beside_a_run(command, name, tmp_path, monkeypatch):
    """Elsewhere the flag says where to write; here it would do nothing."""
    monkeypatch.chdir(tmp_path)
    word = ["endmembers"] if command is export else []
    said = refused(command, *word, "--run", tmp_path, "--output-dir", name)
    assert "a run is named" in said
    assert "The folder to write to is --output" in said
    assert not (tmp_path / name).exists()


def test_a_folder_to_look_for_runs_is_refused_beside_runs_to_compare(tmp_path):
    said = refused(evaluate, tmp_path / "a", tmp_path / "b", "--output-dir", tmp_path)
    assert "a run is named" in said


@pytest.mark.slow
def test_two_processes_find_what_one_finds(evaluated, tmp_path):
    path = Path(shutil.copytree(evaluated[0], tmp_path / "run"))
    alone = (path / "eval" / "metrics.json").read_bytes()
    shutil.rmtree(path / "eval")
    done(evaluate, "--run", path, "--device", "cpu", "--num-devices", 2)
    assert (path / "eval" / "metrics.json").read_bytes() == alone
    pictures = [{one.name for one in (run / "eval").glob("*/*.png")} for run in (path, evaluated[0])]
    assert pictures[0] == pictures[1]


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "new look.yml"
    path.write_text("edits:\n- rename: {endmember: 0, name: cloth}\n- scale: {endmember: 1, factor: 0.5}\n")
    return path


def metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_an_edited_run_is_evaluated_into_a_folder_of_its_own(evaluated, tmp_path, recipe):
    run_copy = Path(shutil.copytree(evaluated[0], tmp_path / "run"))
    before = metrics(run_copy / "eval")
    ended = done(evaluate, "--run", run_copy, "--edits", recipe, "--device", "cpu")
    assert metrics(run_copy / "eval") == before
    folder = run_copy / "exports" / "eval-new_look"
    found = metrics(folder)
    assert found["psnr"] != before["psnr"]
    assert found["miou"] == before["miou"]
    assert "name: cloth" in found["edits"]
    assert "edits" not in before
    assert str(folder) in ended.out
    assert "edited, against the scene as measured" in " ".join(ended.out.split())
    assert min(picture_size(folder / "rgb" / "eval_002.png")) > 100
    # Another light lights prediction and truth alike; the scene's is nearly flat, so that figures nearly stay.
    ended = done(evaluate, "--run", run_copy, "--illuminant", "e", "--device", "cpu")
    found = metrics(run_copy / "exports" / "eval-e")
    assert found["psnr"] == pytest.approx(before["psnr"], abs=0.5)
    assert found["psnr"] != before["psnr"]
    assert found["endmember_angle"] == pytest.approx(before["endmember_angle"], abs=0.05)
    assert "in the same light" in " ".join(ended.out.split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--edits", "gone.yml"], "can't read the recipe gone.yml"),
        (["--data", "/gone/for/good"], "/gone/for/good"),
    ],
)
def test_what_is_wrong_with_edits_or_data_exits_2_and_writes_nothing(run_copy, words, message):
    assert message in refused(evaluate, "--run", run_copy, *words)
    assert not (run_copy / "eval").exists()
    assert not (run_copy / "exports").exists()


def test_the_gain_of_an_evaluation_view_does_not_count(tmp_path, monkeypatch):
    path = small_run(tmp_path, "--light", "per-view").run
    words = ["--run", path, "--device", "cpu"]
    assert "each evaluation view was aligned first" in done(evaluate, *words).out
    plain = metrics(path / "eval")["psnr_matter"]
    cube = Scene.cube
    monkeypatch.setattr(Scene, "cube", lambda *asked: 0.5 * cube(*asked))
    done(evaluate, *words)
    halved = metrics(path / "eval")["psnr_matter"]
    # Half the light has half the error after alignment: 6 dB.
    assert abs(halved - plain - 6.02) < 0.5


def test_the_gain_of_a_view_of_a_rig_does_not_count_either_nor_in_a_report(trained, tmp_path):
    loaded, measured = load_run(trained.run, "cpu"), load_scene(trained.scene)
    fitting = replace(loaded.materials_scene, fitted=("gain",))
    rig = replace(measured, sensors=measured.sensors * 2)
    assert rig.is_rig
    show = lambda _, items: iter(items)  # noqa: E731
    found: Any = [evaluate_scene(fitting, one, None, tmp_path, show, ALONE) for one in (measured, rig)]
    plain, seen = found
    assert seen.more["aligned"] == ["gain"]
    assert seen.figures["psnr"] == pytest.approx(plain.figures["psnr"])
    quiet = (lambda _: None, lambda _: nullcontext(), show)
    job = Job(replace(loaded, scene=fitting), tmp_path, False, *quiet, ALONE)
    views: Any = compared_views(job, job.views("eval"), measured)
    assert views.evaluation.figures() == pytest.approx(plain.figures)


def test_several_runs_are_compared_in_one_table(run_copy, tmp_path):
    other = Path(shutil.copytree(run_copy, tmp_path / "other"))
    ended = done(evaluate, run_copy, other, "--device", "cpu")
    folder = run_copy / "exports" / "comparison"
    assert str(folder) in ended.out
    rows = (folder / "figures.csv").read_text().splitlines()[1:]
    assert {row.split(",")[0] for row in rows} == set(KEYS)
    assert all(row.endswith(",+0") for row in rows)
    assert len(list(folder.rglob("*.png"))) == 6
    errors = [float(row.split(",")[2]) for row in (folder / "band_rmse.csv").read_text().splitlines()[1:]]
    per_view = np.square(errors).reshape(2, 8).mean(axis=1) ** 0.5
    assert [one["rmse"] for one in metrics(other / "eval")["per_view"]] == pytest.approx(per_view, rel=1e-4)
    for words, said in (
        ([run_copy, run_copy], "a run is named twice"),
        (["--run", run_copy, other], "either with --run or without it"),
        ([run_copy, tmp_path / "nothing"], "no run folder at"),
    ):
        shutil.rmtree(run_copy / "eval", ignore_errors=True)
        assert said in refused(evaluate, *words)
        assert not (run_copy / "eval").exists()  # the first is not evaluated in vain
