"""Turns on a device: exclusive, in the proportion stated, and nobody waits for ever."""

import math
import threading
import time

import pytest

from unmix_plugin.engine.training.device_share import SHARE_BOUNDS, DeviceShare

STEP_S = 0.004


def busy(seconds):
    """Take time as computing does, without being interrupted."""
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        pass


def contest(share, seconds, cost=1.0):
    """Part of the time that a guest that always wants more gets beside training."""
    device = DeviceShare(share)
    device.is_training = True
    spent = {"guest": 0.0, "training": 0.0}
    until = time.monotonic() + seconds

    def be_guest():
        while time.monotonic() < until:
            with device.guest_turn(cost):
                started = time.perf_counter()
                busy(STEP_S)
                spent["guest"] += time.perf_counter() - started

    guest = threading.Thread(target=be_guest)
    guest.start()
    while time.monotonic() < until or guest.is_alive():
        with device.training_turn():
            started = time.perf_counter()
            busy(STEP_S)
            spent["training"] += time.perf_counter() - started
    guest.join()
    return spent["guest"] / (spent["guest"] + spent["training"])


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
                time.sleep(0.0002)
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
def test_a_guest_that_always_wants_more_gets_its_share(share):
    # What an idle guest has saved comes on top, hence a run long enough for it not to count much.
    assert contest(share, 2.5) == pytest.approx(share, abs=0.1)


def test_work_that_may_wait_gets_less():
    assert contest(0.4, 2.5, cost=4.0) < 0.3


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
    assert went.wait(5)
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
