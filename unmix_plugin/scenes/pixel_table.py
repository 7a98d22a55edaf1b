"""The measured pixels that training draws from: of each sensor a block, one after the other, as far as memory goes.

Pixels become rays, as many through the pixels of a coarse sensor as through those of a sharp one. A coarse pixel is the
mean of many fine ones, but one ray through each of those would leave a batch with a few coarse pixels: too few to learn
from, and all their rays end in the same cells, so that the other cells seem to be seen by no view.

Notation: `R` pixels, `b` channels of a sensor, `P` rays through each pixel.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Literal, TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.space import RayBundle
from unmix_plugin.engine.machine import step_generator
from unmix_plugin.engine.processes import processes_here
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.pixel_block import DrawnPixels, PixelBlock
from unmix_plugin.scenes.pixel_projection import FEWEST_CHANNELS, Projection
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bad_values import FEWEST_BANDS, deviation_limits, deviations
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA

_GIB = 2**30
_USABLE_SHARE, _GIVEN_SHARE = 0.8, 0.85
"""Of the memory that is left, and of the memory that was given: reading and drawing pixels takes some, too."""
_LARGEST_POOL = 2**30
"""Of pixels on disk; more in memory would not be drawn from more evenly."""
_PIXELS_TO_JUDGE_BY = 20_000
_MOST_LISTED = 1 << 22
"""Pixels of a block that are listed one by one to sample from; of larger blocks some are."""


def available_bytes(device: torch.device) -> int | None:
    """Memory that a device has left, as far as the system says; None where it doesn't."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration):
        names = getattr(os, "sysconf_names", {})
        if not {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= names.keys():
            return None
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:  # a container may have less than its machine
        group = Path("/sys/fs/cgroup")
        limit, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
    except (OSError, ValueError):
        return free
    return min(free, max(0, limit - used))


Components: TypeAlias = int | Literal["auto", "none"]


class PixelTable:
    """What training draws from; a draw is a function of its generator and the step alone."""

    def __init__(
        self,
        scene: Scene,
        device: torch.device,
        views: tuple[int, ...],
        memory_gb: float | None = None,
        *,
        components: Components = "none",
        mends: bool = False,
        seed: int = 0,
    ) -> None:
        """Read the pixels, or what of them `memory_gb` GiB hold; None for most of the memory that is left.

        Args:
            components: Numbers a pixel to keep instead of its channels. Auto is none where all channels fit.
            mends: Whether to replace stripes and spikes in memory (see `spectral.bad_values`).
            seed: Of the pixels by which the scene is judged.
        Raises:
            ConfigError: no pixel is valid.
            SpectrumError: too few pixels for so many components.
        """
        cameras_of: dict[int, list[int]] = {}
        for camera, view in enumerate(views):
            cameras_of.setdefault(scene.frames[view].sensor, []).append(camera)
        self.blocks: tuple[PixelBlock, ...] = tuple(
            PixelBlock(scene, tuple(views[camera] for camera in cameras), tuple(cameras), device)
            for _, cameras in sorted(cameras_of.items())
        )
        self._firsts = list(accumulate((len(block) for block in self.blocks), initial=0))
        if not any(bool(block.valid.any()) for block in self.blocks):
            raise ConfigError(Message.NO_VALID_PIXEL.sentence())
        self._scene, self._seed, self._mends = scene, seed, mends
        self.notes = self._read(device, memory_gb, components)
        """What a user should know of pixels that are not held as they were stored."""

    def _read(self, device: torch.device, memory_gb: float | None, components: Components) -> list[str]:
        """Hold all pixels, as they are stored or as components, or else a pool of them; gives the notes."""
        budget = None if memory_gb is None else int(_GIVEN_SHARE * memory_gb * _GIB)
        if memory_gb is None and (available := available_bytes(device)) is not None:
            num_sharing = processes_here() if device.type == "cpu" else 1
            budget = int(_USABLE_SHARE * (available // num_sharing))
        total = sum(block.num_bytes for block in self.blocks)
        fits = budget is None or total <= budget
        found = {} if components == "none" or (components == "auto" and fits) else self._projected(components)
        needed = total
        for block in self.blocks:
            if block.sensor in found:
                needed += int(len(block) * (5 + found[block.sensor].pixel_bytes)) - block.num_bytes
        spare = None if budget is None else budget - needed
        if (spare is None or spare >= 0) and self._hold(found, spare):
            return [projection.describe() for projection in found.values()]

        budget = needed if budget is None else budget
        pool = min(_LARGEST_POOL, budget) if memory_gb is None else budget
        for block in self.blocks:
            block.hold_part(pool * block.num_bytes // total)
        held = sum(block.pool.num_bytes for block in self.blocks if block.pool is not None)
        what = " and ".join(block.description for block in self.blocks)
        notes = [Message.KEPT_ON_DISK.sentence(what=what, total=total / _GIB, held=held / _GIB)]
        if not isinstance(components, str):
            values = {"components": components, "needed": max(needed, budget) / _GIB}
            notes.append(Message.COMPONENTS_OF_NO_USE.sentence(**values))
        return notes

    def _hold(self, found: Mapping[int, Projection], spare: int | None) -> bool:
        """Read all pixels, those of some sensors as components, into so many bytes more than is expected; None for any
        number. False: they would take more, and what is held is of no use."""
        for block in self.blocks:
            limits = self._limits(block)
            if block.sensor not in found:
                block.hold()
                if limits is not None:
                    block.mend(limits)
                continue
            expected = int(len(block) * found[block.sensor].pixel_bytes)
            if not block.hold_projected(
                found[block.sensor], limits, None if spare is None else expected + spare
            ):
                return False
            spare = None if spare is None else spare - max(0, block.held_bytes - expected)
        return True

    def _projected(self, components: Components) -> dict[int, Projection]:
        """By sensor, of blocks whose pixels are to be kept as components."""
        number = None if isinstance(components, str) else components
        found = {}
        for block in self.blocks:
            if block.num_channels < (FEWEST_CHANNELS if number is None else number + 1):
                continue
            pixels = self.sample_opaque(block.sensor, _PIXELS_TO_JUDGE_BY, self._seed)
            limits = self._limits(block)
            if limits is not None:
                pixels = pixels[(deviations(pixels).abs() <= limits).all(dim=1)]
            if number is None and len(pixels) < 2 * (block.num_channels + 1):
                continue
            projection = Projection(pixels, number)
            if number is not None or projection.pays(block.pixel_bytes):
                found[block.sensor] = projection
        return found

    def _limits(self, block: PixelBlock) -> Float[Tensor, " b"] | None:
        """From which on deviations in a block may be bad values; None where they are not looked for."""
        bands = self._scene.sensors[block.sensor].bands
        if not self._mends or bands is None or len(bands) < FEWEST_BANDS or list(bands) != sorted(bands):
            return None
        pixels = self.sample_opaque(block.sensor, _PIXELS_TO_JUDGE_BY, self._seed)
        return deviation_limits(pixels) if len(pixels) else None

    @property
    def bad_share(self) -> float:
        """Share of the values in memory that were replaced by what is around them."""
        num_values = sum(len(block) * block.num_channels for block in self.blocks)
        return sum(block.num_bad for block in self.blocks) / num_values

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
        return [None if bool(b.valid.all()) else b.valid.nonzero()[:, 0].int() for b in self.blocks]

    def draw(
        self, count: int, generator: torch.Generator, step: int = 0, shares: Mapping[int, float] | None = None
    ) -> tuple[DrawnPixels, ...]:
        """Random valid pixels, in one group for each sensor that some of them are of: by shares of the pixels drawn, or
        evenly. What pixels on disk are drawn from moves on with the step of the training."""
        counts = [count]
        if len(self.blocks) != 1 or self.blocks[0].pool is not None:
            # As many pixels of each block as chance gives its sensor.
            shares = self.shares if shares is None else shares
            bounds = torch.tensor([shares.get(block.sensor, 0.0) for block in self.blocks]).cumsum(0)
            places = torch.rand(count, generator=generator).clamp(max=float(bounds[-1]) - 1e-6)
            counts = torch.bincount(torch.searchsorted(bounds, places), minlength=len(self.blocks)).tolist()
        groups = []
        for index, (block, number) in enumerate(zip(self.blocks, counts, strict=True)):
            first = self._firsts[index]
            if number and block.pool is not None:
                pixels, stored = block.pool.draw(number, step, generator)
                groups.append(block.take(pixels, first, stored))
            elif number:
                valid = self._valid[index]
                size = len(block) if valid is None else len(valid)
                drawn = torch.randint(size, (number,), generator=generator)
                groups.append(block.take(drawn if valid is None else valid[drawn].long(), first))
        return tuple(groups)

    def sample_opaque(
        self, sensor: int, count: int, seed: int, kept: Bool[Tensor, " pixels"] | None = None
    ) -> Float[Tensor, "_ b"]:
        """Spectra of at most `count` random valid pixels of a sensor that are opaque, and `kept` if that is given."""
        block = next(block for block in self.blocks if block.sensor == sensor)
        pool: Int[Tensor, " pool"]
        if len(block) > _MOST_LISTED:
            some = torch.Generator().manual_seed(seed)
            pool = torch.randint(len(block), (_MOST_LISTED // 2,), generator=some).unique()
            pool = pool[block.valid[pool]]
        else:
            pool = torch.arange(len(block)) if bool(block.valid.all()) else block.valid.nonzero()[:, 0]
        pool = pool if kept is None else pool[kept[pool]]
        opaque = pool[block.alpha.cpu()[pool] > OPAQUE_ALPHA]
        chosen = opaque[torch.randperm(len(opaque), generator=step_generator(seed, 0))[:count]]
        return block.spectra(chosen.to(block.alpha.device)).cpu()


class PixelRays:
    """Rays through pixels of a scene's training views."""

    def __init__(self, scene: Scene, device: torch.device) -> None:
        self._scene = scene
        self._cameras = scene.cameras[list(scene.train_indices)]
        self._device_cameras: Cameras = self._cameras.to(device)

    @cached_property
    def pixel_sizes(self) -> dict[int, float]:
        """Of each sensor, the edge of a pixel where it looks at the middle of the scene box, median over its views."""
        centre = self._scene.scene_box.aabb.mean(dim=0)
        distances = (self._cameras.camera_to_world[:, :, 3] - centre).norm(dim=-1)
        if self._scene.is_unbounded:  # cameras may be in the middle of what they see
            distances = distances.clamp(min=float(self._scene.scene_box.size.max()) / 2)
        edges = distances / self._cameras.focal_px.mean(dim=-1)
        sensors = torch.tensor([self._scene.frames[view].sensor for view in self._scene.train_indices])
        return {sensor: float(edges[sensors == sensor].median()) for sensor in set(sensors.tolist())}

    def shares(self, valid: Mapping[int, float]) -> dict[int, float]:
        """Of the pixels of a batch, by sensor: in proportion to the area that the pixels of its views cover.

        Drawn evenly (`valid`, shares of all), the pixels of a sharp sensor, which are many, would leave hardly any of a
        coarse one.
        """
        areas = {sensor: share * self.pixel_sizes[sensor] ** 2 for sensor, share in valid.items()}
        return {sensor: area / sum(areas.values()) for sensor, area in areas.items()}

    def through(self, pixels: DrawnPixels, subpixels: int, generator: torch.Generator) -> RayBundle:
        """Rays through pixels of one sensor, those of a pixel one after the other: a random one in each cell of a
        `subpixels` x `subpixels` grid on it."""
        cells = torch.arange(subpixels)
        grid = torch.stack(torch.meshgrid(cells, cells, indexing="xy"), dim=-1).reshape(1, -1, 2)
        within = torch.rand(len(pixels.cameras), subpixels**2, 2, generator=generator)
        offsets = ((grid + within) / subpixels).to(pixels.corners.device)
        points = (pixels.corners[:, None] + offsets).flatten(0, 1)
        return self._device_cameras.generate_rays(pixels.cameras.repeat_interleave(subpixels**2), points)
