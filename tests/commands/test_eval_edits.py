"""`unmix-eval --edits --illuminant`: what is compared, where it is written, and that `eval/` is left alone."""

import json

import pytest

from tests.commands.running import picture_size, run
from unmix_plugin.commands.eval import evaluate


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "new look.yml"
    path.write_text("edits:\n- rename: {endmember: 0, name: cloth}\n- scale: {endmember: 1, factor: 0.5}\n")
    return path


def metrics(folder):
    return json.loads((folder / "metrics.json").read_text())


def test_an_edited_run_is_evaluated_into_a_folder_of_its_own(run_copy, recipe):
    plain = run(evaluate, "--run", run_copy, "--device", "cpu")
    before = metrics(run_copy / "eval")
    ended = run(evaluate, "--run", run_copy, "--edits", recipe, "--device", "cpu")
    assert (plain.status, ended.status) == (0, 0), ended.err
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


def test_another_light_lights_prediction_and_truth_alike(run_copy):
    ended = run(evaluate, "--run", run_copy, "--illuminant", "e", "--device", "cpu")
    plain = run(evaluate, "--run", run_copy, "--device", "cpu")
    assert (ended.status, plain.status) == (0, 0), ended.err
    found, before = metrics(run_copy / "exports" / "eval-e"), metrics(run_copy / "eval")
    # The scene's light is nearly flat: the figures are nearly those of the unedited run, though not quite.
    assert found["psnr"] == pytest.approx(before["psnr"], abs=0.5)
    assert found["psnr"] != before["psnr"]
    assert found["endmember_angle"] == pytest.approx(before["endmember_angle"], abs=0.05)
    assert "in the same light" in " ".join(ended.out.split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--illuminant", "D66"], "there is no light 'D66'; nearest: D65"),
        (["--edits", "gone.yml"], "can't read the recipe gone.yml"),
    ],
)
def test_what_is_wrong_with_edits_exits_2_and_writes_nothing(run_copy, words, message):
    ended = run(evaluate, "--run", run_copy, *words)
    assert ended.status == 2
    assert message in ended.err
    assert not (run_copy / "eval").exists()
    assert not (run_copy / "exports").exists()
