"""A part of the pixels of a scene that is larger than memory, renewed from disk as training goes on.

The pixels are cut into chunks of neighbours, and these are put in a random order, again and again. The pool holds a run
of that order and moves along it as steps go by, one chunk at a time: so the disk is read in large pieces, every chunk
stays as long as any other, and what the pool holds at a step follows from the step alone. A thread reads the chunks
that come next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from jaxtyping import Bool, Int
from torch import Tensor

_CHUNK_BYTES, _PIXELS_PER_STEP = 4 << 20, 2048
_PLACE_BYTES = 16
"""Of a pixel that is held, beside its values: its number, and its place among those that can be drawn."""
_CHUNKS_AHEAD = 4
"""Read before they are needed."""
_ORDER_SEED = 23


class PixelPool:
    """Values of some of a block's pixels at each step."""

    def __init__(
        self,
        valid: Bool[Tensor, " pixels"],
        pixel_bytes: int,
        num_bytes: int,
        read: Callable[[int, int], Tensor],
        *,
        chunk_bytes: int | None = None,
        pixels_per_step: int | None = None,
    ) -> None:
        """
        Args:
            valid: Pixels of the block that may be drawn, on the CPU; at least one.
            pixel_bytes: Of a pixel's values.
            num_bytes: Memory of the pool; at least two chunks are held.
            read: Stored values (pixels, b) from a first pixel to one before a last, called in another thread.
            chunk_bytes: Of values read at once.
            pixels_per_step: Drawn in a usual step: so many pixels are renewed in it, too.
        """
        self._chunk_pixels = max(1, min((chunk_bytes or _CHUNK_BYTES) // pixel_bytes, len(valid)))
        firsts = range(0, len(valid), self._chunk_pixels)
        self._firsts = [first for first in firsts if bool(valid[first : first + self._chunk_pixels].any())]
        held_bytes = self._chunk_pixels * (pixel_bytes + _PLACE_BYTES)
        self._num_held = min(len(self._firsts), max(2, num_bytes // held_bytes))
        self.num_bytes = self._num_held * self._chunk_pixels * pixel_bytes
        """Memory that the values held take."""
        self._steps_per_chunk = max(1, self._chunk_pixels // (pixels_per_step or _PIXELS_PER_STEP))
        self._valid, self._read = valid, read
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="pixels")
        self._arriving: dict[int, Future[Tensor]] = {}
        self._held = [-1] * self._num_held
        """Position in the order of the chunk in each slot."""
        self._numbers = torch.full((self._num_held * self._chunk_pixels,), -1)
        """Index in the block of each pixel held; -1 where it can't be drawn."""
        self._values: Tensor | None = None

    def draw(self, count: int, step: int, generator: torch.Generator) -> tuple[Int[Tensor, " R"], Tensor]:
        """Random valid pixels of the block by their index in it, and their stored values (R, b)."""
        self._move_to(step // self._steps_per_chunk)
        assert self._values is not None
        chosen = self._drawable[torch.randint(len(self._drawable), (count,), generator=generator)]
        return self._numbers[chosen], self._values[chosen]

    def _move_to(self, first: int) -> None:
        """Hold the chunks of the order from `first` on; where that is no step ahead, all are read again."""
        wanted = range(first, first + self._num_held)
        if sorted(self._held) == list(wanted):
            return
        for position in [position for position in self._arriving if position < first]:
            self._arriving.pop(position).cancel()
        missing = [position for position in wanted if position not in self._held]
        coming = [*missing, *range(wanted.stop, wanted.stop + _CHUNKS_AHEAD)]
        for index, position in enumerate(missing):
            self._ask_for(coming[index : index + 1 + _CHUNKS_AHEAD])  # all at once would be in memory twice
            self._put(position, self._arriving.pop(position).result())
        self._ask_for(coming[len(missing) :])
        self._drawable = (self._numbers >= 0).nonzero()[:, 0]

    def _ask_for(self, positions: Sequence[int]) -> None:
        """Have the chunks at these positions of the order read."""
        for position in positions:
            if position not in self._arriving:
                self._arriving[position] = self._reader.submit(self._read, *self._range(position))

    def _put(self, position: int, values: Tensor) -> None:
        """A chunk in its slot."""
        if self._values is None:
            self._values = values.new_empty(len(self._numbers), values.shape[1])
        slot = position % self._num_held
        start = slot * self._chunk_pixels
        first, last = self._range(position)
        self._values[start : start + len(values)] = values
        self._numbers[start : start + self._chunk_pixels] = -1
        numbers = torch.where(self._valid[first:last], torch.arange(first, last), -1)
        self._numbers[start : start + len(values)] = numbers
        self._held[slot] = position

    def _range(self, position: int) -> tuple[int, int]:
        """First pixel of the chunk at a position of the order, and the one after its last."""
        turn, place = divmod(position, len(self._firsts))
        generator = torch.Generator().manual_seed(_ORDER_SEED + turn)
        first = self._firsts[int(torch.randperm(len(self._firsts), generator=generator)[place])]
        return first, min(first + self._chunk_pixels, len(self._valid))
