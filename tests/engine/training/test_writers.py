"""Metrics as JSON lines and TensorBoard files, events as a log."""

import errno
import importlib.util
import json
import math
from pathlib import Path

import pytest
import torch

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.progress import MetricsWriter, RunLog
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.errors import RunError

HAS_TENSORBOARD = importlib.util.find_spec("tensorboard") is not None


@pytest.fixture
def without_tensorboard(monkeypatch: pytest.MonkeyPatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "tensorboard" else real(name)
    )


@pytest.mark.usefixtures("without_tensorboard")
def test_each_write_is_one_json_line_and_what_is_not_finite_is_null(tmp_path: Path):
    writer = MetricsWriter(RunFolder(tmp_path))
    writer.write(1, 0.12345, "train", {"loss": 0.5, "psnr": math.inf})
    writer.write(2, 1.0, "eval_all", {"psnr": 30.0})
    writer.write_images(2, {"rgb": torch.zeros(2, 2, 3)})
    writer.close()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert lines == [
        {"step": 1, "seconds": 0.123, "split": "train", "loss": 0.5, "psnr": None},
        {"step": 2, "seconds": 1.0, "split": "eval_all", "psnr": 30.0},
    ]
    assert not (tmp_path / "tensorboard").exists()


@pytest.mark.skipif(not HAS_TENSORBOARD, reason="tensorboard is not installed")
def test_tensorboard_gets_the_same_numbers_where_it_is_installed(tmp_path: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    writer = MetricsWriter(RunFolder(tmp_path))
    writer.write(1, 0.1, "train", {"loss": 0.5})
    writer.write(2, 0.2, "train", {"loss": 0.25})
    writer.write_images(2, {"rgb": torch.rand(4, 5, 3)})
    writer.close()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("train/loss")] == [(1, 0.5), (2, 0.25)]
    assert (events.Images("eval/rgb")[0].height, events.Images("eval/rgb")[0].width) == (4, 5)


@pytest.mark.usefixtures("without_tensorboard")
def test_resuming_cuts_off_later_lines_and_a_half_written_one(tmp_path: Path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"step": 1}\n{"step": 2}\n{"step": 3}\n[]\n{"step": 4, "lo')
    MetricsWriter(RunFolder(tmp_path), resumed_step=2).write(3, 0.0, "train", {})
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [1, 2, 3]


def test_the_log_dates_each_event(tmp_path: Path):
    log = RunLog(RunFolder(tmp_path))
    log.write("started")
    log.write("saved step 5")
    first, second = (tmp_path / "run.log").read_text().splitlines()
    assert first.endswith("+00:00 started")
    assert second.endswith("+00:00 saved step 5")
    assert first[:4].isdigit()


def test_a_full_disk_while_saving_ends_training_with_a_clear_error_and_the_last_checkpoint(
    short_config: TrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    trainer = Trainer(short_config)
    saved: list[int] = []
    original = trainer.save

    def save_then_fill_the_disk() -> None:
        original()
        saved.append(trainer.step)
        monkeypatch.setattr("os.write", refuse)

    def refuse(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(trainer, "save", save_then_fill_the_disk)
    with pytest.raises(RunError, match=r"No space left on device.*go on with --load-run"):
        trainer.train()
    assert saved == [4]
    names = sorted(path.name for path in trainer.run.checkpoints.iterdir())
    assert names == ["step-000004.json", "step-000004.safetensors"]
    assert "failed at step 8: RunError" in trainer.log.path.read_text()
