"""What keeps processes from working together is said once, by the first of a machine."""

import pytest
import torch
from torch import distributed

from unmix_plugin.engine.processes.processes import ALONE, Follower, join
from unmix_plugin.errors import ConfigError


@pytest.fixture
def second_of_two(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """The environment of the second process of two on one machine that has two GPUs."""
    for name, value in {"RANK": 1, "WORLD_SIZE": 2, "LOCAL_RANK": 1, "LOCAL_WORLD_SIZE": 2}.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", lambda _: None)
    return monkeypatch


def test_too_few_devices_are_told_by_the_first_process_alone(second_of_two):
    second_of_two.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(Follower) as ended:
        join("cuda")
    assert ended.value.code == 2
    second_of_two.setenv("LOCAL_RANK", "0")
    with pytest.raises(ConfigError, match="2 processes on this machine, which has 1 CUDA devices"):
        join("cuda")


@pytest.mark.parametrize(("device", "backend"), [("cuda", "nccl"), ("cpu", "gloo")])
def test_a_pytorch_that_lacks_what_processes_talk_through_is_told_by_the_first(
    second_of_two, device, backend
):
    second_of_two.setattr(distributed, f"is_{backend}_available", lambda: False)
    with pytest.raises(Follower):
        join(device)
    second_of_two.setenv("LOCAL_RANK", "0")
    with pytest.raises(ConfigError, match=f"built without {backend}"):
        join(device)


def test_a_process_that_was_started_alone_has_nothing_to_join(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert join("cuda") is ALONE
