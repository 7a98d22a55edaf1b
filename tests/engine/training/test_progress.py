"""When training ends, what is shown of it, and what is written down."""

import errno
import importlib.util
import io
import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.runs.loading import load_config
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training import trainer as trainer_module
from unmix_plugin.engine.training.progress import (
    MetricsWriter,
    ProgressConsole,
    ProgressDisplay,
    TrainingStatus,
)
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.engine.training.training_control import Interrupted
from unmix_plugin.errors import ConfigError, RunError

limits = st.tuples(st.none() | st.integers(0, 10_000), st.none() | st.floats(1e-3, 1e4)).filter(any)
steps, seconds = st.integers(0, 20_000), st.floats(0, 2e4)


@given(limits, steps, seconds, st.integers(0, 100), st.floats(0, 100))
def test_progress_is_the_nearer_limits_fraction_and_never_falls(limit, step, spent, more, longer):
    config = TrainerConfig(max_num_iterations=limit[0], max_seconds=limit[1])
    progress = config.progress(step, spent)
    assert 0.0 <= progress <= config.progress(step + more, spent + longer) <= 1.0
    is_over = [most is not None and done >= most for done, most in zip((step, spent), limit, strict=True)]
    assert any(is_over) == (progress == 1.0)
    if not any(is_over) and limit[1] is None:
        assert progress == step / limit[0]


@pytest.fixture
def fake_time(monkeypatch):
    """A clock that goes on by `tick` whenever it is read, and by hand."""
    fake = SimpleNamespace(now=0.0, tick=0.0)

    def read():
        fake.now += fake.tick
        return fake.now

    monkeypatch.setattr(trainer_module, "time", SimpleNamespace(perf_counter=read))
    return fake


def test_a_limit_in_seconds_ends_training_in_time_with_the_schedule_run_out(short_config, fake_time):
    fake_time.tick = 1 / 64
    trainer = Trainer(replace(short_config, max_num_iterations=None, max_seconds=0.5, steps_per_save=0))
    record = trainer.train()
    assert (record.steps, record.train_seconds) == (32, 0.5)
    assert record.progress == 1.0
    assert record.learning_rates["fields"] < 0.2 * 0.2
    resumed = Trainer(replace(load_config(trainer.run.path), max_seconds=0.75)).train()
    assert (resumed.steps, resumed.train_seconds) == (48, 0.75)


def test_seconds_of_evaluation_saving_and_warming_up_do_not_count(short_config, monkeypatch, fake_time):
    fake_time.tick = 1 / 64
    often = {"steps_per_eval_all_images": 1, "steps_per_save": 1}
    trainer = Trainer(replace(short_config, max_num_iterations=3, **often))
    slow = {"eval": 0, "warm": 0}

    def evaluate():
        slow["eval"] += 1
        fake_time.now += 400
        return {"psnr": 1.0}, {}

    def warm_up():
        slow["warm"] += 1
        fake_time.now += 400

    monkeypatch.setattr(trainer.pipeline, "get_average_eval_image_metrics_and_images", evaluate)
    monkeypatch.setattr(trainer.pipeline.model, "warm_up", warm_up)
    record = trainer.train()
    assert slow == {"eval": 3, "warm": 1}
    assert record.train_seconds == 3 / 64


STATUS = TrainingStatus(
    step=120, seconds=30.0, progress=0.25, loss=0.00123, psnr=31.5, rays_per_second=18_200.0
)


def test_a_status_says_step_loss_psnr_speed_and_time_left():
    assert str(STATUS) == "step 120   25 %  loss 0.00123  psnr 31.50 dB  18.2k rays/s  1:30 left"
    bare = replace(STATUS, psnr=None, progress=0.0, rays_per_second=2.4e6)
    assert str(bare) == "step 120    0 %  loss 0.00123  2.4M rays/s"
    assert str(replace(STATUS, seconds=7200.0)).endswith("6:00:00 left")


def test_where_the_output_is_no_terminal_each_status_is_one_plain_line():
    out = io.StringIO()
    display = ProgressDisplay(Console(file=out, width=40), plain_interval_s=0.0)
    with display:
        assert display.is_due
        display.show(STATUS)
        display.message("saved [bold]x[/bold]")
    assert out.getvalue() == f"{STATUS}\nsaved [bold]x[/bold]\n"
    assert not ProgressDisplay(Console(file=out), plain_interval_s=100.0).is_due


@pytest.mark.parametrize("width", [40, 60, 200])
def test_on_a_terminal_the_bar_is_redrawn_in_place_and_the_time_left_is_never_cut_off(width):
    out = io.StringIO()
    with ProgressDisplay(Console(file=out, force_terminal=True, width=width, color_system=None)) as display:
        display.show(STATUS)
        display.message("a line that stays")
        display.show(replace(STATUS, step=121))
    assert "\x1b[2K" in out.getvalue()
    assert "step 121   25 %" in out.getvalue()
    assert "1:30 left" in out.getvalue()
    assert out.getvalue().count("a line that stays") == 1


def test_a_console_that_is_gone_ends_training_with_all_saved(short_config, monkeypatch):
    class Gone(io.StringIO):
        def write(self, _):
            raise BrokenPipeError

    monkeypatch.setattr(ProgressDisplay, "is_due", property(lambda self: not self.is_closed))
    trainer = Trainer(short_config, console=ProgressConsole(file=Gone()))
    with pytest.raises(Interrupted) as stopped:
        trainer.train()
    assert stopped.value.step == 1
    assert "its output is closed" in trainer.run.log_path.read_text()


def test_training_off_a_terminal_prints_lines_without_control_codes(short_config, monkeypatch):
    monkeypatch.setattr(ProgressDisplay, "is_due", property(lambda _: True))
    out = io.StringIO()
    config = replace(short_config, steps_per_eval_all_images=6)
    Trainer(config, console=Console(file=out)).train()
    lines = out.getvalue().splitlines()
    assert len(lines) == 14
    assert "\x1b" not in out.getvalue()
    assert re.fullmatch(r"step 12  100 %  loss \S+  psnr \S+ dB  \S+ rays/s  0:00 left", lines[-2])
    assert re.fullmatch(r"step 12: evaluation views: psnr [\d.]+", lines[-1])


HAS_TENSORBOARD = importlib.util.find_spec("tensorboard") is not None


@pytest.fixture
def without_tensorboard(monkeypatch):
    real = importlib.util.find_spec
    find_spec = lambda name: None if name == "tensorboard" else real(name)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", find_spec)


@pytest.mark.usefixtures("without_tensorboard")
def test_each_write_is_one_json_line_and_what_is_not_finite_is_null(tmp_path):
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


@pytest.mark.parametrize("name", ["step", "seconds", "split"])
def test_a_metric_that_would_overwrite_where_its_line_belongs_is_refused(tmp_path, name):
    with pytest.raises(ConfigError, match=f"no metric of a model may be called {name}"):
        MetricsWriter(RunFolder(tmp_path)).write(1, 0.1, "train", {name: 7.0})


@pytest.mark.skipif(not HAS_TENSORBOARD, reason="tensorboard is not installed")
def test_tensorboard_gets_the_same_numbers_where_it_is_installed(tmp_path):
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
def test_resuming_cuts_off_later_lines_odd_ones_and_a_half_written_one(tmp_path):
    path = tmp_path / "metrics.jsonl"
    odd = b"\xff\xfe\n" + b"[" * 100_000 + b"\nnull\n[1]\n{}\n"
    path.write_bytes(b'\xef\xbb\xbf{"step": 1}\n' + odd + b'{"step": 2}\n{"step": 3}\n{"step": 4, "lo')
    MetricsWriter(RunFolder(tmp_path), resumed_step=2).write(3, 0.0, "train", {})
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [1, 2, 3]


def test_a_full_disk_while_saving_ends_training_with_its_last_checkpoint(short_config, monkeypatch):
    trainer = Trainer(short_config)
    saved: list[int] = []
    original = trainer.save

    def save_then_fill_the_disk():
        original()
        saved.append(trainer.step)
        monkeypatch.setattr("os.write", refuse)

    def refuse(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(trainer, "save", save_then_fill_the_disk)
    with pytest.raises(RunError, match=r"No space left on device.*go on with --load-run"):
        trainer.train()
    assert saved == [4]
    names = sorted(path.name for path in trainer.run.checkpoints.glob("[!.]*"))
    assert names == ["step-000004.json", "step-000004.safetensors"]
    assert "failed at step 8: RunError" in trainer.run.log_path.read_text()
