"""Devices by name; randomness is a function of seed, step and stream."""

import random

import numpy as np
import pytest
import torch

from unmix_plugin.engine.machine import resolve_device, seed_everything, step_generator, step_seed
from unmix_plugin.errors import ConfigError


def test_auto_is_cuda_where_there_is_one_and_the_cpu_elsewhere(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert resolve_device("auto") == resolve_device("cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    assert resolve_device("auto") == resolve_device("cuda") == torch.device("cuda", 0)
    assert resolve_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize(("built_for", "advice"), [(None, "install a CUDA build"), ("12.8", "nvidia-smi")])
def test_cuda_without_cuda_is_refused_with_what_to_do(monkeypatch, built_for, advice):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", built_for)
    with pytest.raises(ConfigError, match=f"--device cuda, but .*{advice}.*leave --device at auto"):
        resolve_device("cuda")
    with pytest.raises(ConfigError, match="must be auto, cpu or cuda; got 'tpu'"):
        resolve_device("tpu")


def test_neighbouring_seeds_steps_and_streams_are_all_different_and_each_draws_what_it_drew():
    first, again, other = (torch.rand(5, generator=step_generator(1, 7, stream=x)) for x in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    found = {step_seed(seed, step, stream) for seed in range(20) for step in range(50) for stream in range(5)}
    assert len(found) == 20 * 50 * 5
    assert all(0 <= seed < 2**63 for seed in found)


def test_seeding_everything_repeats_torch_numpy_and_python():
    def draw():
        seed_everything(5)
        return float(torch.rand(())), float(np.random.rand()), random.random()  # noqa: NPY002

    assert draw() == draw()
    assert draw()[0] == float(torch.rand(torch.Size(), generator=torch.Generator().manual_seed(5)))


@pytest.mark.parametrize("is_used", [True, False])
def test_gpus_are_seeded_where_they_are_in_use(monkeypatch, is_used):
    seeded = []
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: is_used)
    monkeypatch.setattr(torch.cuda, "manual_seed_all", seeded.append)
    seed_everything(7)
    assert seeded == ([7] if is_used else [])
