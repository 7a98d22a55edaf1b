"""Watching and steering a training from another thread: it does as asked between steps, and nothing else changes."""

import io
import threading
import time
from dataclasses import replace

import pytest
import torch
from rich.console import Console

from tests.engine.stopped_runs import call_after_step, newest, quiet_trainer
from unmix_plugin.engine.runs.load_run import load_config
from unmix_plugin.engine.runs.run_folder import checkpoint_steps
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.engine.training.training_control import Interrupted


def in_background(work):
    """A thread that does something, started."""
    thread = threading.Thread(target=work)
    thread.start()
    return thread


def wait_for(holds, timeout_s=120.0):
    until = time.monotonic() + timeout_s
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.002)


def wait_for_rounds(control, number):
    """Until the paused loop has looked that many times whether it may go on."""
    seen, look = threading.Semaphore(0), control.wait_while_paused

    def counted(*args):
        seen.release()
        return look(*args)

    control.wait_while_paused = counted
    for _ in range(number):
        assert seen.acquire(timeout=120)
    control.wait_while_paused = look


@pytest.mark.parametrize("average_decay", [None, 0.9])
def test_a_guest_on_the_device_changes_nothing_of_a_training(short_config, average_decay):
    config = replace(short_config, average_decay=average_decay)
    alone, watched = quiet_trainer(config), quiet_trainer(config)
    alone.train()
    model, camera = watched.pipeline.model, watched.pipeline.datamanager.eval_cameras[0]
    is_over = threading.Event()

    def watch():
        while not is_over.is_set():
            with watched.control.device.guest_turn():
                training = model.training
                model.eval()
                model.get_outputs_for_camera(camera)
                model.train(training)

    guest = in_background(watch)
    watched.train()
    is_over.set()
    guest.join()
    expected, actual = newest(alone.run.path).tensors, newest(watched.run.path).tensors
    assert set(expected) == set(actual)
    for name, tensor in expected.items():
        assert torch.equal(tensor, actual[name]), name


def test_a_pause_stops_the_steps_and_the_clock_until_it_is_over(short_config):
    trainer = quiet_trainer(short_config)
    control = trainer.control
    call_after_step(trainer, 5, control.pause)
    thread = in_background(trainer.train)
    wait_for(lambda: control.is_paused and trainer.step == 5)
    assert control.is_running
    assert not control.device.is_training
    seconds = trainer.clock.seconds
    wait_for_rounds(control, 3)
    assert (trainer.step, trainer.clock.seconds) == (5, seconds)
    control.resume()
    thread.join(120)
    assert trainer.step == 12
    assert not control.is_running
    assert not control.device.is_training


def test_a_paused_training_saves_when_asked_and_not_otherwise(short_config):
    trainer = quiet_trainer(replace(short_config, steps_per_save=0))
    call_after_step(trainer, 3, trainer.control.pause)
    thread = in_background(trainer.train)
    wait_for(lambda: trainer.control.is_paused and trainer.step == 3)
    wait_for_rounds(trainer.control, 3)
    assert checkpoint_steps(trainer.run.checkpoints) == []
    turns = trainer.control.device.training_turns
    trainer.control.request_save()
    wait_for(lambda: checkpoint_steps(trainer.run.checkpoints) == [3])
    assert trainer.step == 3
    assert trainer.control.device.training_turns <= turns + 1
    trainer.control.resume()
    thread.join(120)


def test_a_checkpoint_that_is_asked_for_is_saved_after_the_step(short_config):
    trainer = quiet_trainer(replace(short_config, steps_per_save=0, checkpoints_kept=5))
    call_after_step(trainer, 7, trainer.control.request_save)
    trainer.train()
    assert sorted(checkpoint_steps(trainer.run.checkpoints)) == [7, 12]


@pytest.mark.parametrize("is_paused", [False, True])
def test_a_stop_ends_training_as_ctrl_c_does_and_it_can_go_on(short_config, is_paused):
    trainer = quiet_trainer(short_config)
    control = trainer.control

    def stop():
        if is_paused:
            control.pause()
        control.request_stop()

    call_after_step(trainer, 6, stop)
    with pytest.raises(Interrupted) as stopped:
        trainer.train()
    assert stopped.value.step == 6
    assert not control.is_running
    resumed = quiet_trainer(load_config(stopped.value.run))
    resumed.train()
    assert resumed.step == 12


def test_a_guest_that_leaves_the_model_in_evaluation_mode_does_not_change_the_next_step(short_config):
    trainer = quiet_trainer(short_config)
    modes = []

    def leave_in_evaluation_mode() -> None:
        trainer.pipeline.eval()

    call_after_step(trainer, 3, leave_in_evaluation_mode)
    for step in range(1, 13):
        call_after_step(trainer, step, lambda: modes.append(trainer.pipeline.model.training))
    trainer.pipeline.eval()  # a page that rendered before the first step
    trainer.train()
    assert modes == [True, True, False] + 9 * [True]


def test_kernels_are_compiled_in_a_turn_of_training(short_config, monkeypatch):
    trainer = quiet_trainer(short_config)
    device, owners = trainer.control.device, []
    monkeypatch.setattr(trainer.pipeline.model, "warm_up", lambda: owners.append(device._owner))
    trainer.train()
    assert owners == [threading.get_ident()]


def test_the_terminal_says_when_training_pauses_and_goes_on(short_config):
    out = io.StringIO()
    trainer = Trainer(short_config, console=Console(file=out))
    call_after_step(trainer, 5, trainer.control.pause)
    thread = in_background(trainer.train)
    wait_for(lambda: "paused at step 5" in out.getvalue())
    trainer.control.resume()
    thread.join(120)
    assert out.getvalue().count("paused") == 1
    assert "resumed at step 5" in out.getvalue()


def test_the_status_follows_the_training(short_config, monkeypatch):
    monkeypatch.setattr("unmix_plugin.engine.training.training_control._STATUS_INTERVAL_S", 0.0)
    trainer = quiet_trainer(short_config)
    seen = []
    for step in range(1, 13):
        call_after_step(trainer, step, lambda: seen.append(trainer.control.status))
    trainer.train()
    assert seen[0] is None
    assert [status.step for status in seen[1:]] == list(range(1, 12))
    assert trainer.control.status is not None
    assert trainer.control.status.step == 12
    assert trainer.control.status.progress == 1.0
