"""Randomness as a function of (seed, step), so that a resumed run draws what a straight one drew."""

import random

import numpy as np
import torch

_MASK = (1 << 64) - 1


def step_seed(seed: int, step: int, stream: int = 0) -> int:
    """A seed in [0, 2^63) for one step of one stream of randomness; nearby arguments give unrelated seeds.

    Source:
        Steele, Lea and Flood 2014, the finaliser of SplitMix64, applied once an argument.
    """
    state = 0
    for value in (seed, step, stream):
        state = _mixed((state ^ (value & _MASK)) + 0x9E3779B97F4A7C15)
    return state >> 1


def step_generator(
    seed: int, step: int, device: torch.device | str = "cpu", stream: int = 0
) -> torch.Generator:
    """A generator for one step; `stream` keeps two uses in the same step apart."""
    return torch.Generator(device=device).manual_seed(step_seed(seed, step, stream))


def seed_everything(seed: int) -> None:
    """Seed the global generators of torch, NumPy and Python, which a method's own code may use."""
    torch.manual_seed(seed)
    np.random.seed(step_seed(seed, 0) & 0xFFFFFFFF)  # noqa: NPY002
    random.seed(seed)


def _mixed(value: int) -> int:
    value &= _MASK
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & _MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & _MASK
    return value ^ (value >> 31)
