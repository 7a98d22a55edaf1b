"""Turns on a device: exclusive, in the proportion stated, and nobody waits forever."""

import math
import threading
import time
from types import SimpleNamespace

import pytest

from unmix_plugin.engine.training import training_control as device_share
from unmix_plugin.engine.training.training_control import SHARE_BOUNDS, DeviceShare

STEP_S = 0.004


def busy(seconds):
    """Take time as computing does, without being interrupted."""
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        pass


@pytest.fixture
def contest(monkeypatch):
    """Part of the time that a guest that always wants more gets beside training, each step taking `STEP_S`."""
    now = [0.0]
    monkeypatch.setattr(device_share, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def run(share, cost=1.0, steps=2500):
        device, taken, is_over = DeviceShare(share), {"guest": 0, "training": 0}, threading.Event()
        device.is_training = True

        def step(turn, who):
            with turn:
                now[0] += STEP_S
                taken[who] += not is_over.is_set()

        def be_guest():
            while not is_over.is_set():
                step(device.guest_turn(cost), "guest")

        guest = threading.Thread(target=be_guest)
        guest.start()
        for _ in range(steps):
            while device._num_waiting == 0:  # the guest is on its way to its next turn
                time.sleep(0)
            step(device.training_turn(), "training")
        is_over.set()
        device.is_training = False
        guest.join(120)
        return taken["guest"] / sum(taken.values())

    return run


def test_turns_never_overlap():
    device = DeviceShare(0.5)
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

    guest = threading.Thread(target=take, args=(device.guest_turn,))
    guest.start()
    while guest.is_alive():
        with device.training_turn():
            inside += 1
            most = max(most, inside)
            inside -= 1
    guest.join()
    assert most == 1


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_guest_that_always_wants_more_gets_its_share(contest, share):
    # What an idle guest has saved comes on top, hence a run long enough for it not to count much.
    assert contest(share) == pytest.approx(share, abs=0.02)


def test_work_that_may_wait_gets_less(contest):
    # A guest's second costs four: 0.4 / 0.6 of training's are earned, a quarter of them taken.
    assert contest(0.4, cost=4.0) == pytest.approx(1 / 7, abs=0.02)


def test_without_training_a_guest_never_waits():
    device = DeviceShare(0.05)
    started = time.monotonic()
    for _ in range(50):
        with device.guest_turn(100.0):
            busy(0.001)
    device.charge(1000.0)
    with device.guest_turn():
        pass
    assert time.monotonic() - started < 5


def test_what_a_guest_took_before_training_is_forgotten():
    device = DeviceShare(0.05)
    device.charge(1000.0)
    device.is_training = True
    assert device.guest_may_go


def test_a_guest_that_waits_for_credit_goes_on_when_training_ends():
    device = DeviceShare(0.05)
    device.is_training = True
    device.charge(1000.0)
    went = threading.Event()

    def be_guest():
        with device.guest_turn():
            went.set()

    guest = threading.Thread(target=be_guest)
    guest.start()
    assert not went.wait(0.1)
    device.is_training = False
    assert went.wait(120)
    guest.join()


def test_an_error_in_a_turn_gives_the_device_back():
    device = DeviceShare()
    for turn in (device.training_turn, device.guest_turn):
        with pytest.raises(ZeroDivisionError), turn():
            raise ZeroDivisionError
    with device.training_turn():
        pass


@pytest.mark.parametrize("inner", ["training_turn", "guest_turn"])
@pytest.mark.parametrize("outer", ["training_turn", "guest_turn"])
def test_a_turn_within_a_turn_is_refused_rather_than_waited_for_for_ever(outer, inner):
    device = DeviceShare()
    refused = pytest.raises(RuntimeError, match="turns do not nest")
    with getattr(device, outer)(), refused, getattr(device, inner)():
        pass
    with getattr(device, inner)():
        pass


def test_training_turns_are_counted():
    device = DeviceShare()
    for _ in range(3):
        with device.training_turn():
            pass
    with device.guest_turn():
        pass
    assert device.training_turns == 3


@pytest.mark.parametrize(("asked", "kept"), [(-1.0, SHARE_BOUNDS[0]), (7.0, SHARE_BOUNDS[1]), (0.3, 0.3)])
def test_shares_stay_within_bounds(asked, kept):
    device = DeviceShare(asked)
    assert device.guest_share == kept
    device.guest_share = math.nan
    assert device.guest_share == SHARE_BOUNDS[0]


def test_a_turn_of_training_that_has_not_begun_comes_after_the_guests_turn_under_way():
    device, order = DeviceShare(), []

    def warm_up():
        with device.training_turn():
            order.append("training")

    training = threading.Thread(target=warm_up)
    with device.guest_turn():
        training.start()
        while not device._is_training_waiting:
            time.sleep(0)
    for _ in range(3):
        with device.guest_turn():
            order.append("guest")
    training.join(120)
    assert order == ["training", "guest", "guest", "guest"]
