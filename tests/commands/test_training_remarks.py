"""What is said of a training that did not settle."""

import json

import pytest

from unmix_plugin.commands.training_remarks import read_remarks, remarks


def course(*quarters: float) -> list[dict]:
    """Five lines a quarter of a training, around a loss each, one batch far off."""
    return [
        {"step": 50 * (5 * quarter + row + 1), "loss": loss * (10 if row == 2 else 1), "split": "train"}
        for quarter, loss in enumerate(quarters)
        for row in range(5)
    ]


@pytest.mark.parametrize(
    ("quarters", "said"),
    [
        ((1.0, 0.4, 0.2, 0.16), None),
        ((1.0, 0.9, 0.85, 0.8), "hardly fell: in the last quarter of the training it was 80%"),
        ((1.0, 0.6, 0.4, 0.2), "still fell by 50%"),
    ],
)
def test_a_training_that_did_not_settle_is_told_from_one_that_did(quarters, said):
    found = remarks(course(*quarters))
    assert len(found) == (said is not None)
    assert said is None or said in found[0]


def test_few_lines_and_losses_that_are_not_finite_say_nothing():
    assert remarks(course(1.0, 0.9, 0.85, 0.8)[-5:]) == []
    assert remarks([{**line, "loss": None} for line in course(1.0, 0.9, 0.85, 0.8)]) == []


def test_remarks_are_read_from_the_metrics_of_a_run(tmp_path):
    path = tmp_path / "metrics.jsonl"
    lines = [*course(1.0, 0.9, 0.85, 0.8), {"step": 1000, "split": "eval_all", "psnr": 20.0}]
    path.write_text("\n".join(json.dumps(line) for line in lines) + "\n")
    assert "hardly fell" in read_remarks(path)[0]
    path.write_text('{"step": 1')
    assert read_remarks(path) == []
    assert read_remarks(tmp_path / "missing.jsonl") == []


def test_poses_that_ran_away_are_said():
    lines = course(1.0, 0.2, 0.1, 0.09)
    assert remarks([*lines[:-1], {**lines[-1], "poses_undone": 0.0}]) == []
    said = remarks([*lines[:-1], {**lines[-1], "poses_undone": 3.0}])
    assert "corrections of the poses of 3 views went beyond" in said[0]


def test_poses_that_are_not_believed_are_said():
    lines = course(1.0, 0.2, 0.1, 0.09)
    assert remarks([*lines[:-1], {**lines[-1], "poses_doubted": 0.01}]) == []
    said = remarks([*lines[:-1], {**lines[-1], "poses_doubted": 0.12}])
    assert "12% of the views, or of the rows of line cameras, still fit far worse than the others" in said[0]
