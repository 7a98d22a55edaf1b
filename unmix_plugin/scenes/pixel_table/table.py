"""All pixels of some views, drawn evenly from the valid ones: of each sensor a block, one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import accumulate

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from unmix_plugin.engine.training.seeding import step_generator
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.pixel_table import memory
from unmix_plugin.scenes.pixel_table.block import DrawnPixels, PixelBlock
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bad_values import FEWEST_BANDS, deviation_limits

OPAQUE_ALPHA = 0.99
_PIXELS_TO_MEND_BY = 20_000
MOST_LISTED = 1 << 24
"""Pixels of a block that are listed one by one to sample from; of larger blocks some are."""


class PixelTable:
    """What training draws from; a draw is a function of its generator and the step alone."""

    def __init__(
        self, scene: Scene, device: torch.device, views: tuple[int, ...], memory_gb: float | None = None
    ) -> None:
        """Read the pixels, or what of them `memory_gb` GiB hold; None for most of the memory that is left.

        Raises:
            ConfigError: no pixel is valid.
        """
        cameras_of: dict[int, list[int]] = {}
        for camera, view in enumerate(views):
            cameras_of.setdefault(scene.frames[view].sensor, []).append(camera)
        self.blocks = tuple(
            PixelBlock(scene, tuple(views[camera] for camera in cameras), tuple(cameras))
            for _, cameras in sorted(cameras_of.items())
        )
        held, total = memory.pool_bytes(self.blocks, device, memory_gb), sum(b.num_bytes for b in self.blocks)
        for block in self.blocks:
            block.read(device, None if held is None else held * block.num_bytes // total)
        self.note = memory.describe_pool(self.blocks)
        """What a user should know of pixels that stay on disk; None if none does."""
        self._firsts = list(accumulate((len(block) for block in self.blocks), initial=0))
        if not any(bool(block.valid.any()) for block in self.blocks):
            raise ConfigError("no valid pixel is left in the training views: masks leave out every one")

    def __len__(self) -> int:
        return self._firsts[-1]

    @cached_property
    def shares(self) -> dict[int, float]:
        """Of each sensor the share of the valid pixels."""
        counts = {block.sensor: int(block.valid.sum()) for block in self.blocks}
        return {sensor: count / sum(counts.values()) for sensor, count in counts.items()}

    @cached_property
    def _valid(self) -> list[Int[Tensor, " valid"] | None]:
        """Of each block, the indices of its valid pixels; None if all are."""
        return [None if bool(b.valid.all()) else b.valid.nonzero()[:, 0] for b in self.blocks]

    def draw(
        self,
        count: int,
        generator: torch.Generator,
        step: int = 0,
        shares: Mapping[int, float] | None = None,
    ) -> tuple[DrawnPixels, ...]:
        """Random valid pixels, in one group for each sensor that some of them are of.

        Args:
            step: Of the training; what pixels on disk are drawn from moves on with it.
            shares: Of the pixels drawn, by sensor; None draws all valid ones evenly.
        """
        if self.note is None and len(self.blocks) == 1:
            return (self.blocks[0].take(self._drawn(0, count, generator), 0),)
        counts = self._counts(count, generator, self.shares if shares is None else shares)
        groups = []
        for index, (block, number) in enumerate(zip(self.blocks, counts, strict=True)):
            if number == 0:
                continue
            if self.note is None:
                groups.append(block.take(self._drawn(index, number, generator), self._firsts[index]))
            elif block.pool is not None:
                pixels, stored = block.pool.draw(number, step, generator)
                groups.append(block.take(pixels, self._firsts[index], stored))
        return tuple(groups)

    def _drawn(self, block: int, count: int, generator: torch.Generator) -> Int[Tensor, " R"]:
        """Random valid pixels of a block held in memory, by their index in it."""
        valid = self._valid[block]
        drawn = torch.randint(
            len(self.blocks[block]) if valid is None else len(valid), (count,), generator=generator
        )
        return drawn if valid is None else valid[drawn]

    def _counts(self, count: int, generator: torch.Generator, shares: Mapping[int, float]) -> list[int]:
        """As many pixels of each block as chance gives its sensor."""
        bounds = torch.tensor([shares.get(block.sensor, 0.0) for block in self.blocks]).cumsum(0)
        places = torch.rand(count, generator=generator).clamp(max=float(bounds[-1]) - 1e-6)
        return torch.bincount(torch.searchsorted(bounds, places), minlength=len(self.blocks)).tolist()

    def mend(self, scene: Scene, seed: int) -> float:
        """Replace stripes and spikes in memory (see `spectral.bad_values`); share of the values that were bad."""
        bad = total = 0
        for block in self.blocks:
            bands = scene.sensors[block.sensor].bands
            if (
                block.pool is not None
                or bands is None
                or len(bands) < FEWEST_BANDS
                or list(bands) != sorted(bands)
            ):
                continue
            pixels = torch.from_numpy(self.sample_opaque(block.sensor, _PIXELS_TO_MEND_BY, seed))
            if len(pixels):
                bad += block.mend(deviation_limits(pixels))
                total += len(block) * len(bands)
        return bad / max(total, 1)

    def sample_opaque(self, sensor: int, count: int, seed: int) -> Float[np.ndarray, "pixels b"]:
        """Spectra of at most `count` random valid pixels of a sensor that are opaque."""
        block = next(block for block in self.blocks if block.sensor == sensor)
        pool: Int[Tensor, " pool"]
        if len(block) > MOST_LISTED:
            some = torch.Generator().manual_seed(seed)
            pool = torch.randint(len(block), (MOST_LISTED // 8,), generator=some).unique()
            pool = pool[block.valid[pool]]
        else:
            pool = torch.arange(len(block)) if bool(block.valid.all()) else block.valid.nonzero()[:, 0]
        opaque = pool[block.alpha.cpu()[pool] > OPAQUE_ALPHA]
        chosen = opaque[torch.randperm(len(opaque), generator=step_generator(seed, 0))[:count]]
        return block.spectra(chosen.to(block.alpha.device)).cpu().numpy()
