"""Turns on a device, and a training that is watched and steered from another thread."""

import io
import math
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from rich.console import Console

from tests.factories.trainings import call_after_step, newest, quiet_trainer
from unmix_plugin.engine.runs.loading import load_config
from unmix_plugin.engine.runs.run_folder import checkpoint_steps
from unmix_plugin.engine.training import training_control as device_share
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.engine.training.training_control import (
    SHARE_BOUNDS,
    DeviceLock,
    Interrupted,
    TrainingControl,
)

STEP_S = 0.004


def in_background(work):
    """A thread that does something, started."""
    thread = threading.Thread(target=work)
    thread.start()
    return thread


@pytest.fixture
def contest(monkeypatch):
    """Part of the time that a viewer that always wants more gets beside training, each step taking `STEP_S`."""
    now = [0.0]
    monkeypatch.setattr(device_share, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def run(share, cost=1.0, steps=2500):
        device, taken, is_over = DeviceLock(share), {"viewer": 0, "training": 0}, threading.Event()
        device.is_training = True

        def step(turn, who):
            with turn:
                now[0] += STEP_S
                taken[who] += not is_over.is_set()

        def be_viewer():
            while not is_over.is_set():
                step(device.viewing_turn(cost), "viewer")

        viewer = in_background(be_viewer)
        for _ in range(steps):
            step(device.training_turn(), "training")
        is_over.set()
        device.is_training = False
        viewer.join(120)
        return taken["viewer"] / sum(taken.values())

    return run


def test_turns_never_overlap():
    device = DeviceLock(0.5)
    device.is_training = True
    inside, most = 0, 0

    def take(turn):
        nonlocal inside, most
        for _ in range(100):
            with turn():
                inside += 1
                most = max(most, inside)
                time.sleep(0)  # lets the other thread run, which must not enter
                inside -= 1

    viewer = in_background(lambda: take(device.viewing_turn))
    take(device.training_turn)
    viewer.join()
    assert most == 1


# What an idle viewer has saved comes on top, hence a run long enough for it not to count much. Where a viewer's second
# costs four, 0.4 / 0.6 of training's are earned, and a quarter of them taken.
@pytest.mark.parametrize(("share", "cost", "part"), [(0.2, 1.0, 0.2), (0.5, 1.0, 0.5), (0.4, 4.0, 1 / 7)])
def test_a_viewer_gets_its_share_and_less_for_work_that_may_wait(contest, share, cost, part):
    assert contest(share, cost) == pytest.approx(part, abs=0.02)


def test_without_training_a_viewer_never_waits():
    device = DeviceLock(0.05)
    started = time.monotonic()
    with device.viewing_turn(1e6):
        time.sleep(0.001)
    device.charge(1000.0)
    with device.viewing_turn():
        pass
    assert time.monotonic() - started < 5
    device.is_training = True
    assert device.viewing_may_go  # what it took before training is forgotten


def test_a_viewer_that_waits_for_credit_goes_on_when_training_ends():
    device = DeviceLock(0.05)
    device.is_training = True
    device.charge(1000.0)
    went = threading.Event()

    def be_viewer():
        with device.viewing_turn():
            went.set()

    viewer = in_background(be_viewer)
    assert not went.wait(0.1)
    device.is_training = False
    assert went.wait(120)
    viewer.join()


@pytest.mark.parametrize("inner", ["training_turn", "viewing_turn"])
@pytest.mark.parametrize("outer", ["training_turn", "viewing_turn"])
def test_a_turn_within_a_turn_is_refused_and_an_error_in_one_gives_the_device_back(outer, inner):
    device = DeviceLock()
    refused = pytest.raises(RuntimeError, match="turns do not nest")
    with getattr(device, outer)(), refused, getattr(device, inner)():
        pass
    with pytest.raises(ZeroDivisionError), getattr(device, outer)():
        raise ZeroDivisionError
    with getattr(device, inner)():
        pass


def test_shares_stay_within_bounds():
    low, high = SHARE_BOUNDS
    assert [DeviceLock(share).viewing_share for share in (-1.0, 7.0, 0.3, math.nan)] == [low, high, 0.3, low]


def test_a_turn_of_training_that_has_not_begun_comes_after_the_viewers_turn_under_way():
    device, order = DeviceLock(), []

    def warm_up():
        with device.training_turn():
            order.append("training")

    with device.viewing_turn():
        training = in_background(warm_up)
        wait_for(lambda: device.num_waiting("training") == 1)
    for _ in range(3):
        with device.viewing_turn():
            order.append("viewer")
    training.join(120)
    assert order == ["training", "viewer", "viewer", "viewer"]


def test_viewers_have_their_turns_in_the_order_in_which_they_asked():
    device, order = DeviceLock(), []

    def draw(name, pictures):
        for _ in range(pictures):
            with device.viewing_turn():
                order.append(name)
                time.sleep(0.005)

    with device.viewing_turn():
        viewers = []
        for name in ("page", "picture"):
            viewers.append(in_background(lambda name=name: draw(name, 5)))
            wait_for(lambda: device.num_waiting("viewer") == len(viewers))
    for viewer in viewers:
        viewer.join(120)
    assert order == ["page", "picture"] * 5


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
def test_a_viewer_on_the_device_changes_nothing_of_a_training(short_config, average_decay):
    config = replace(short_config, average_decay=average_decay)
    alone, watched = quiet_trainer(config), quiet_trainer(config)
    alone.train()
    model, camera = watched.pipeline.model, watched.pipeline.datamanager.eval_cameras[0]
    is_over = threading.Event()

    def watch():
        while not is_over.is_set():
            with watched.control.device.viewing_turn():
                training = model.training
                model.eval()
                model.get_outputs_for_camera(camera)
                model.train(training)

    viewer = in_background(watch)
    watched.train()
    is_over.set()
    viewer.join()
    expected, actual = newest(alone.run.path).tensors, newest(watched.run.path).tensors
    assert set(expected) == set(actual)
    for name, tensor in expected.items():
        assert torch.equal(tensor, actual[name]), name


def test_a_pause_stops_the_steps_and_the_clock_until_it_is_over(short_config):
    out = io.StringIO()
    trainer = Trainer(short_config, console=Console(file=out))
    control, warmed = trainer.control, []

    def warm_up():  # kernels are compiled once, in a turn of training
        with pytest.raises(RuntimeError, match="turns do not nest"), control.device.viewing_turn():
            pass
        warmed.append(threading.get_ident())

    trainer.pipeline.model.warm_up = warm_up
    call_after_step(trainer, 5, control.pause)
    thread = in_background(trainer.train)
    wait_for(lambda: control.is_paused and trainer.step == 5)
    assert warmed == [thread.ident]
    assert control.is_running
    assert not control.device.is_training
    seconds = trainer.seconds
    wait_for_rounds(control, 3)
    assert (trainer.step, trainer.seconds) == (5, seconds)
    control.resume()
    thread.join(120)
    assert trainer.step == 12
    assert not control.is_running
    assert not control.device.is_training
    assert out.getvalue().count("paused at step 5") == out.getvalue().count("resumed at step 5") == 1


def test_a_paused_training_saves_when_asked_and_not_otherwise(short_config):
    trainer = quiet_trainer(replace(short_config, steps_per_save=0, checkpoints_kept=5))
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
    call_after_step(trainer, 7, trainer.control.request_save)
    trainer.control.resume()
    thread.join(120)
    assert sorted(checkpoint_steps(trainer.run.checkpoints)) == [3, 7, 12]


def test_a_save_asked_for_at_a_step_that_saves_anyway_is_made_once(short_config):
    trainer = quiet_trainer(replace(short_config, steps_per_save=4, checkpoints_kept=9))
    call_after_step(trainer, 4, trainer.control.request_save)
    trainer.train()
    assert sorted(checkpoint_steps(trainer.run.checkpoints)) == [4, 8, 12]


@pytest.mark.parametrize("is_paused", [False, True])
def test_a_stop_ends_training_as_ctrl_c_does_and_it_can_go_on(short_config, is_paused):
    control = TrainingControl()
    trainer = Trainer(short_config, console=Console(file=io.StringIO()), control=control)

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


def test_a_viewer_that_leaves_the_model_in_evaluation_mode_does_not_change_the_next_step(short_config):
    trainer = quiet_trainer(short_config)
    modes = []

    call_after_step(trainer, 3, trainer.pipeline.eval)
    for step in range(1, 13):
        call_after_step(trainer, step, lambda: modes.append(trainer.pipeline.model.training))
    trainer.pipeline.eval()  # a page that rendered before the first step
    trainer.train()
    assert modes == [True, True, False] + 9 * [True]


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
