"""A run that was stopped and resumed is the run that was never stopped."""

import json
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from tests.factories.rgb_nerf import BallDataManager
from tests.factories.systems import SIGNALS_TO_END, needs_posix
from tests.factories.trainings import call_after_step, finished, newest, quiet_trainer, stop_at
from unmix_plugin.engine.runs.loading import load_config
from unmix_plugin.engine.runs.run_folder import RunLock, checkpoint_steps
from unmix_plugin.engine.training.training_control import Interrupted
from unmix_plugin.errors import RunError


def press_ctrl_c_twice() -> None:
    signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGINT)


def train_lines(run: Path) -> list[dict]:
    """Metrics lines without what depends on the clock."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k not in ("seconds", "rays_per_second")} for line in lines]


@pytest.mark.parametrize(
    ("number", "average_decay"), [(signal.SIGINT, None), *((number, 0.9) for number in SIGNALS_TO_END)]
)
def test_stopped_and_resumed_equals_straight_to_the_bit(short_config, number, average_decay):
    config = replace(short_config, average_decay=average_decay)
    straight = finished(config)
    stopped = stop_at(config, 6, number)
    assert stopped.step == 6
    resumed = quiet_trainer(load_config(stopped.run))
    assert resumed.step == 6
    assert [float(state["step"]) for state in resumed.optimizer.state.values()] == [6.0]
    log = resumed.run.log_path.read_text()
    assert "stopped at step 6: on request" in log
    assert "failed" not in log
    resumed.train()
    assert resumed.run.path == stopped.run
    expected, actual = newest(straight.run.path), newest(resumed.run.path)
    assert actual.step == expected.step == 12
    assert set(actual.tensors) == set(expected.tensors)
    assert any(name.startswith("average/") for name in actual.tensors) == (average_decay is not None)
    for name, tensor in expected.tensors.items():
        assert torch.equal(actual.tensors[name], tensor), name
    for key in ("learning_rates", "num_rays", "total_rays", "skipped_steps", "average_updates", "progress"):
        assert actual.record[key] == expected.record[key], key
    assert train_lines(resumed.run.path) == train_lines(straight.run.path)


def test_a_killed_run_goes_on_from_its_last_checkpoint_and_forgets_later_metrics(short_config):
    class Killed(BaseException):
        pass

    def kill():
        raise Killed

    trainer = quiet_trainer(short_config)
    call_after_step(trainer, 7, kill)
    with pytest.raises(Killed):
        trainer.train()
    assert [line["step"] for line in train_lines(trainer.run.path)] == [1, 2, 3, 4, 5, 6]
    with trainer.run.metrics_path.open("a") as file:
        file.write('{"step": 7, "sec')
    resumed = quiet_trainer(load_config(trainer.run.path))
    assert resumed.step == 4
    resumed.train()
    assert [line["step"] for line in train_lines(trainer.run.path)] == list(range(1, 13))


def test_a_finished_run_resumed_is_left_as_it_is_and_goes_on_to_a_longer_limit(short_config):
    first = finished(short_config)
    before = newest(first.run.path)
    record = quiet_trainer(load_config(first.run.path)).train()
    assert record.steps == 12
    assert newest(first.run.path).record == before.record
    finished(replace(load_config(first.run.path), max_num_iterations=15))
    assert newest(first.run.path).step == 15
    assert load_config(first.run.path).max_num_iterations == 15
    assert first.run.training_path.exists()
    stop_at(replace(load_config(first.run.path), max_num_iterations=20), 17)
    assert not first.run.training_path.exists()  # it told of a training that is no longer the run's


@pytest.mark.parametrize(("step", "saved", "said"), [(6, 4, None), (2, None, "no checkpoint")])
def test_a_second_ctrl_c_stops_within_the_step_and_names_the_last_checkpoint(short_config, step, saved, said):
    trainer = quiet_trainer(short_config)
    call_after_step(trainer, step, press_ctrl_c_twice)
    with pytest.raises(Interrupted, match=said) as caught:
        trainer.train()
    assert caught.value.step == saved
    assert checkpoint_steps(trainer.run.checkpoints) == ([] if saved is None else [saved])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@needs_posix
def test_a_lost_terminal_may_say_so_twice_and_under_nohup_changes_nothing(short_config):
    def hang_up_twice():
        for _ in range(2):
            signal.raise_signal(signal.SIGHUP)

    trainer = quiet_trainer(short_config)
    call_after_step(trainer, 6, hang_up_twice)
    with pytest.raises(Interrupted) as caught:
        trainer.train()
    assert caught.value.step == 6
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        trainer = quiet_trainer(short_config)
        call_after_step(trainer, 6, hang_up_twice)
        assert trainer.train().steps == 12
    finally:
        signal.signal(signal.SIGHUP, previous)


TAKING = """import sys; from pathlib import Path; from unmix_plugin.engine.runs.run_folder import RunLock
lock = RunLock(Path(sys.argv[1]))
"""


def test_a_run_is_trained_by_one_process_at_a_time(short_config):
    run = stop_at(short_config, 6).run
    before = (run / "metrics.jsonl").read_bytes()
    code = TAKING + "print('held', flush=True); sys.stdin.read()"
    words = [sys.executable, "-c", code, str(run / "run.lock")]
    with subprocess.Popen(words, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(RunError, match=rf"another training writes to {run}; stop it"):
            quiet_trainer(load_config(run))
        assert (run / "metrics.jsonl").read_bytes() == before
        other.communicate("")
    assert quiet_trainer(load_config(run)).train().steps == 12


def test_a_lock_that_is_let_go_twice_leaves_that_of_another_holder(tmp_path):
    first, second = RunLock(tmp_path / "lock"), RunLock(tmp_path / "lock")
    first.release()
    first.release()
    del first
    words = [sys.executable, "-c", TAKING, str(tmp_path / "lock")]
    assert b"another training writes to" in subprocess.run(words, capture_output=True, check=False).stderr
    second.release()
    assert subprocess.run(words, capture_output=True, check=False).returncode == 0


def test_resuming_on_another_scene_is_refused(short_config, monkeypatch):
    stopped = stop_at(short_config, 5)
    monkeypatch.setattr(BallDataManager, "metadata", lambda _: {"grid_size": 20, "bands": 3})
    with pytest.raises(RunError, match=r"not the one that .* was trained on: bands differ"):
        quiet_trainer(load_config(stopped.run))
