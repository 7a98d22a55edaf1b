"""The pixels of one sensor in memory, as small as they were stored, or a part of them that is renewed from disk.

Cubes of 8 or 16 bits stay as they are in their files and become float32 when pixels are drawn: half or a quarter of the
memory for the same numbers. Cubes of other types are kept as float32. Pixels of many bands may be kept as a few numbers
each, their components in a subspace. A pixel that the subspace misses by more than noise can explain, or that is
saturated in some band, is kept whole: it may show what no other shows, and of a saturated value one must know that it
is.

Of scenes larger than memory a pool holds some pixels. The block is cut into chunks of neighbouring pixels, and these
are put in a random order, again and again. The pool holds a run of that order and moves along it as steps go by, one
chunk at a time: so the disk is read in large pieces, every chunk stays as long as any other, and what the pool holds at
a step follows from the step alone. A thread reads the chunks that come next.

Notation: `R` drawn pixels, `b` channels of the sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bad_values import REACH_PX, repaired
from unmix_plugin.spectral.subspace import SpectralSubspace, find_subspace

_CHUNK_BYTES = 4 << 20
"""Of values read at once."""
_PIXELS_PER_STEP = 2048
"""Drawn in a usual step: so many pixels are renewed in it, too."""
_CHUNKS_AHEAD = 4
"""Read before they are needed."""
_ORDER_SEED = 23
FEWEST_CHANNELS = 100
"""Of a sensor whose pixels are projected without being asked for."""
_LARGEST_SHARE = 0.25
"""Of the memory of whole pixels that projected ones may take for that."""
_LARGEST_RESIDUAL = 2.0
"""In multiples of the noise; of a pixel that is kept whole it is more. Noise alone makes about 1."""
_UNSATURATED = 0.9999
"""Largest value of a pixel that isn't kept whole: 1 stands for a saturated one."""
_WHOLE_RESERVE = 1.2
"""Room for pixels that are kept whole, in multiples of what some pixels let expect."""
_COMPACT_TYPES = ("f2", "u1", "i1", "i2", "u2")
"""Of NumPy, at most half as large as float32."""
_CHUNK_VALUES, _FEWEST_ROWS = 1 << 21, 8
"""Values of a view in single precision at a time, in whole rows: a view of many bands takes a GB."""
_LARGEST_INT16, _UINT16_VALUES = 2**15 - 1, 2**16


class _PixelPool:
    """Values of some of a block's pixels at each step."""

    def __init__(
        self,
        valid: Bool[Tensor, " pixels"],
        pixel_bytes: int,
        num_bytes: int,
        read: Callable[[int, int], Tensor],
    ) -> None:
        """
        Args:
            valid: Pixels of the block that may be drawn, on the CPU; at least one.
            pixel_bytes: Of a pixel's values.
            num_bytes: Memory of the pool; at least two chunks are held.
            read: Stored values (pixels, b) from a first pixel to one before a last, called in another thread.
        """
        self._chunk_pixels = max(1, min(_CHUNK_BYTES // pixel_bytes, len(valid)))
        firsts = range(0, len(valid), self._chunk_pixels)
        self._firsts = [first for first in firsts if bool(valid[first : first + self._chunk_pixels].any())]
        self._num_held = min(len(self._firsts), max(2, num_bytes // (self._chunk_pixels * pixel_bytes)))
        self._steps_per_chunk = max(1, self._chunk_pixels // _PIXELS_PER_STEP)
        self._valid, self._read, self._pixel_bytes = valid, read, pixel_bytes
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="pixels")
        self._arriving: dict[int, Future[Tensor]] = {}
        self._held: list[int] = []
        """Position in the order of the chunk in each slot; empty before the first draw."""

    @property
    def num_bytes(self) -> int:
        """Memory that the values held take."""
        return self._num_held * self._chunk_pixels * self._pixel_bytes

    def draw(self, count: int, step: int, generator: torch.Generator) -> tuple[Int[Tensor, " R"], Tensor]:
        """Random valid pixels of the block by their index in it, and their stored values (R, b)."""
        self._move_to(step // self._steps_per_chunk)
        chosen = torch.randint(len(self._drawable), (count,), generator=generator)
        return self._numbers[self._drawable[chosen]], self._values[self._drawable[chosen]]

    def _move_to(self, first: int) -> None:
        """Hold the chunks of the order from `first` on; where that is no step ahead, all are read again."""
        wanted = range(first, first + self._num_held)
        if self._held and sorted(self._held) == list(wanted):
            return
        for position in [*wanted, *range(wanted.stop, wanted.stop + _CHUNKS_AHEAD)]:
            if position not in self._held and position not in self._arriving:
                self._arriving[position] = self._reader.submit(self._read, *self._range(position))
        if not self._held:
            self._allocate(self._arriving[first].result())
        for position in wanted:
            if position not in self._held:
                self._put(position, self._arriving.pop(position).result())
        for position in [p for p in self._arriving if p < first or p >= wanted.stop + _CHUNKS_AHEAD]:
            self._arriving.pop(position).cancel()
        self._drawable = (self._numbers >= 0).nonzero()[:, 0]

    def _allocate(self, example: Tensor) -> None:
        self._values = example.new_empty(self._num_held * self._chunk_pixels, example.shape[1])
        self._numbers = torch.full((len(self._values),), -1)
        self._held = [-1] * self._num_held

    def _put(self, position: int, values: Tensor) -> None:
        """A chunk in its slot; numbers of pixels that can't be drawn are -1."""
        slot = position % self._num_held
        start = slot * self._chunk_pixels
        first, last = self._range(position)
        self._values[start : start + len(values)] = values
        numbers = torch.arange(first, last)
        self._numbers[start : start + self._chunk_pixels] = -1
        self._numbers[start : start + len(values)] = torch.where(self._valid[first:last], numbers, -1)
        self._held[slot] = position

    def _range(self, position: int) -> tuple[int, int]:
        """First pixel of the chunk at a position of the order, and the one after its last."""
        turn, place = divmod(position, len(self._firsts))
        generator = torch.Generator().manual_seed(_ORDER_SEED + turn)
        first = self._firsts[int(torch.randperm(len(self._firsts), generator=generator)[place])]
        return first, min(first + self._chunk_pixels, len(self._valid))


@dataclass(frozen=True)
class Projection:
    """How pixels are projected, and what that leaves."""

    subspace: SpectralSubspace
    residual: float
    """Root mean square over some pixels that are not kept whole, in multiples of the noise."""
    whole_share: float
    """Of the pixels, that are kept whole."""

    @staticmethod
    def of(pixels: Float[Tensor, "N b"], num_components: int | None) -> Projection:
        """Judged by the even ones of some pixels, of a subspace that the odd ones are in.

        Args:
            num_components: None finds how many are needed.
        Raises:
            SpectrumError: too few pixels, or too many components.
        """
        subspace = find_subspace(pixels[1::2], num_components)
        seen = pixels[::2]
        residuals = subspace.residuals(seen, subspace.components(seen))
        is_whole = _must_stay_whole(seen, residuals)
        kept = residuals[~is_whole]
        residual = float(kept.square().mean().sqrt()) if len(kept) else float("inf")
        return Projection(subspace, residual, float(is_whole.float().mean()))

    def pixel_bytes(self, num_channels: int) -> float:
        """Memory that a pixel takes in the mean."""
        return 2 * len(self.subspace) + self.whole_share * (2 * num_channels + 8)

    def pays(self, whole_bytes: int) -> bool:
        """Whether results stay what they are and pixels need much less memory than `whole_bytes` each."""
        num_channels = self.subspace.basis.shape[1]
        return self.residual <= 1 and self.pixel_bytes(num_channels) <= _LARGEST_SHARE * whole_bytes

    def describe(self, num_channels: int) -> str:
        """What a user should know."""
        return (
            f"training pixels are kept as {len(self.subspace)} numbers instead of {num_channels} (target-components): "
            f"what they leave out is {self.residual:.2g} of the noise; {self.whole_share:.2%} of the pixels, where it "
            "would be more or which are saturated, are kept whole"
        )


class _ProjectedPixels:
    """Spectra of a block's pixels by the components that they have in a subspace."""

    def __init__(
        self,
        subspace: SpectralSubspace,
        num_pixels: int,
        num_channels: int,
        device: torch.device,
        num_whole: int = 0,
    ) -> None:
        """
        Args:
            num_whole: Pixels that will be kept whole, as far as one knows.
        """
        self._subspace = subspace.to(device)
        self._components = torch.empty(num_pixels, len(subspace), dtype=torch.float16, device=device)
        self._room = torch.empty(num_whole, num_channels, dtype=torch.float16, device=device)
        """Of which the first rows are in use; what isn't takes no memory on a CPU."""
        self._whole = torch.zeros(0, dtype=torch.int64, device=device)

    @property
    def _spectra(self) -> Float[Tensor, "whole b"]:
        """Of pixels kept whole."""
        return self._room[: len(self._whole)]

    @property
    def num_bytes(self) -> int:
        """Memory that the values take."""
        held = (self._components, self._whole, self._spectra)
        return sum(values.numel() * values.element_size() for values in held)

    def put(self, first: int, spectra: Float[Tensor, "R b"]) -> None:
        """Keep pixels that follow each other, the first of which has the number `first`; later ones later."""
        spectra = spectra.to(self._components.device)
        components = self._subspace.components(spectra).half()
        self._components[first : first + len(spectra)] = components
        residuals = self._subspace.residuals(spectra, components.float())
        whole = _must_stay_whole(spectra, residuals).nonzero()[:, 0]
        if len(whole) == 0:
            return
        before, self._whole = len(self._whole), torch.cat([self._whole, first + whole])
        if len(self._whole) > len(self._room):
            room = self._room.new_empty(len(self._whole) * 5 // 4, self._room.shape[1])
            room[:before] = self._room[:before]
            self._room = room
        self._room[before : len(self._whole)] = spectra[whole].half()

    def spectra(self, pixels: Int[Tensor, " R"]) -> Float[Tensor, "R b"]:
        """Spectra of some pixels in [0, 1]."""
        found = self._subspace.spectra(self._components[pixels].float()).clamp_(0, _UNSATURATED)
        if len(self._whole):
            places = torch.searchsorted(self._whole, pixels.contiguous()).clamp_(max=len(self._whole) - 1)
            rows = (self._whole[places] == pixels).nonzero()[:, 0]
            found[rows] = self._spectra[places[rows]].float()
        return found


def _must_stay_whole(spectra: Float[Tensor, "R b"], residuals: Float[Tensor, " R"]) -> Bool[Tensor, " R"]:
    return (residuals > _LARGEST_RESIDUAL) | (spectra.amax(dim=-1) > _UNSATURATED)


@dataclass(frozen=True)
class DrawnPixels:
    """Pixels of one sensor."""

    sensor: int
    """Which of the scene's."""
    numbers: Int[Tensor, " R"]
    """Of the pixels in the table, each its own."""
    cameras: Int[Tensor, " R"]
    """Which of the table's views each is of."""
    corners: Int[Tensor, "R 2"]
    """Column and row."""
    spectra: Float[Tensor, "R b"]
    """What the sensor measured, [0, 1]."""
    alpha: Float[Tensor, " R"]
    """Opacity in [0, 1]; 1 where the scene has no alpha."""


class PixelBlock:
    """All pixels of some views of one sensor, view after view, row after row. Nothing is read before `read_alpha`."""

    alpha: Float[Tensor, " pixels"]
    valid: Bool[Tensor, " pixels"]
    """Pixels that count, on the CPU."""
    num_bad: int
    """Values that were replaced by what is around them."""

    def __init__(self, scene: Scene, views: tuple[int, ...], cameras: tuple[int, ...]) -> None:
        """
        Args:
            views: Frames of the scene, all of one sensor.
            cameras: Which view of the table each is.
        """
        self.sensor = scene.frames[views[0]].sensor
        self._scene, self._views, self.cameras = scene, views, cameras
        self._width, self._height = scene.cameras.size(views[0])
        types = {scene.stored_type(view) for view in views}
        kind = types.pop() if len(types) == 1 else "f4"
        self._is_compact = kind in _COMPACT_TYPES
        self._is_unsigned = kind == "u2"  # PyTorch can't index these, but the same bits as int16
        self._kept = np.dtype("i2" if self._is_unsigned else kind if self._is_compact else "f4")
        self.num_channels = scene.sensors[self.sensor].num_channels
        self.num_bad = 0
        self.pool: _PixelPool | None = None
        self._projected: _ProjectedPixels | None = None
        self._values: Tensor | None = None

    def __len__(self) -> int:
        return len(self._views) * self._width * self._height

    @property
    def value_bytes(self) -> int:
        """Bytes of a number."""
        return self._kept.itemsize

    @property
    def num_bytes(self) -> int:
        """Memory that the pixels take."""
        return len(self) * (self.num_channels * self.value_bytes + 5)

    @property
    def held_bytes(self) -> int:
        """Memory that spectra take once they are read."""
        if self._projected is not None:
            return self._projected.num_bytes
        if self._values is not None:
            return self._values.numel() * self._values.element_size()
        return 0 if self.pool is None else self.pool.num_bytes

    @property
    def description(self) -> str:
        """What makes it so large."""
        return (
            f"{len(self._views)} views x {self._height} x {self._width} pixels x {self.num_channels} bands x "
            f"{self.value_bytes} bytes"
        )

    def read_alpha(self, device: torch.device) -> None:
        """Read to a device what is known of all pixels beside their spectra, which are then read from disk."""
        scene, num_pixels = self._scene, self._width * self._height
        ones = torch.ones(1, device=device)
        alpha = ones.repeat(len(self)) if scene.has_alpha else ones.expand(len(self))  # which takes no memory
        valid = torch.empty(len(self._views), num_pixels, dtype=torch.bool)
        for row, view in enumerate(self._views):
            valid[row] = torch.from_numpy(scene.valid_mask(view)).flatten()
            opacity = scene.alpha(view)
            if opacity is not None:
                alpha[row * num_pixels :][:num_pixels] = torch.from_numpy(opacity).flatten()
        self.alpha, self.valid = alpha, valid.flatten()
        self._camera_of = torch.tensor(self.cameras, device=device)

    def hold(self) -> None:
        """Read all values into the memory of the device."""
        num_pixels = self._width * self._height
        blank = torch.from_numpy(np.empty(0, self._kept))
        values = blank.new_empty(
            len(self._views), num_pixels, self.num_channels, device=self._camera_of.device
        )
        for row, view in enumerate(self._views):
            for top, bottom in self._row_ranges():
                part = slice(top * self._width, bottom * self._width)
                values[row, part] = self._stored(view, (slice(top, bottom),)).to(values.device)
        self._values = values.flatten(0, 1)

    def hold_part(self, num_bytes: int) -> None:
        """Leave the values on disk, and hold so much of them for draws."""
        if self.valid.any():
            pixel_bytes = self.num_channels * self.value_bytes
            self.pool = _PixelPool(self.valid, pixel_bytes, num_bytes, self._read_range)

    def hold_projected(self, projection: Projection, limits: Float[Tensor, " b"] | None) -> None:
        """Read all values, and hold of each pixel its components in a subspace.

        Args:
            limits: As `mend` takes them; None replaces nothing.
        """
        num_pixels, device = self._width * self._height, self._camera_of.device
        num_whole = int(_WHOLE_RESERVE * projection.whole_share * len(self))
        projected = _ProjectedPixels(projection.subspace, len(self), self.num_channels, device, num_whole)
        for row in range(len(self._views)):
            for top, image, places, values in self._looked_through(row, limits):
                image[places] = values
                projected.put(row * num_pixels + top * self._width, image.flatten(0, 1))
        self._projected = projected

    def mend(self, limits: Float[Tensor, " b"]) -> None:
        """Replace stripes and spikes by what is around them, of values held in memory.

        Args:
            limits: As `deviation_limits` gives them.
        """
        assert self._values is not None
        views = self._values.view(-1, self._height, self._width, self.num_channels)
        for row, view in enumerate(views):
            found = [
                (view[top : top + len(image)], places, self._as_stored(values).to(view))
                for top, image, places, values in self._looked_through(row, limits)
                if len(values)
            ]
            for part, places, values in found:  # after the whole view was looked through as it was measured
                part[tuple(index.to(view.device) for index in places)] = values

    def _looked_through(
        self, row: int, limits: Float[Tensor, " b"] | None
    ) -> Iterator[
        tuple[int, Float[Tensor, "n W b"], tuple[Int[Tensor, " values"], ...], Float[Tensor, " values"]]
    ]:
        """First row, some rows of spectra from there on, places of bad values in these and what is around them.

        Args:
            row: Which of the block's views.
            limits: As `mend` takes them; None finds none.
        """
        none = torch.zeros(0, dtype=torch.int64)
        for top, bottom in self._row_ranges():
            above = top if limits is None else max(top - REACH_PX, 0)
            below = bottom if limits is None else min(bottom + REACH_PX, self._height)
            size = self._width * self._height
            if self._values is None:
                stored = self._stored(self._views[row], (slice(above, below),))
            else:
                stored = self._values[
                    row * size + above * self._width : row * size + below * self._width
                ].cpu()
            image = self._scaled(stored).view(below - above, self._width, self.num_channels)
            lines = range(top - above, bottom - above)
            (rows, *others), values = (
                ((none,) * 3, none.float()) if limits is None else repaired(image, limits.cpu(), lines)
            )
            self.num_bad += len(values)
            yield top, image[lines.start : lines.stop], (rows - lines.start, *others), values

    def _row_ranges(self) -> list[tuple[int, int]]:
        """First row, and the one after the last, of parts of a view that are looked at together."""
        step = max(_FEWEST_ROWS, _CHUNK_VALUES // (self._width * self.num_channels))
        return [(top, min(top + step, self._height)) for top in range(0, self._height, step)]

    def spectra(self, pixels: Int[Tensor, " R"]) -> Float[Tensor, "R b"]:
        """Spectra of some pixels in [0, 1], the numbers of `Scene.cube`; only of valid ones."""
        if self._projected is not None:
            return self._projected.spectra(pixels)
        if self._values is not None:
            return self._scaled(self._values[pixels])
        return self._scaled(self._gathered(pixels.cpu())).to(self.alpha.device)

    def _scaled(self, values: Tensor) -> Float[Tensor, "R b"]:
        if not self._is_compact:
            return values
        values = (values.view(torch.uint16) if self._is_unsigned else values).float()
        scale = self._scene.options.value_scale
        return (values if scale is None else values.div_(scale)).clamp_(0.0, 1.0)

    def _as_stored(self, values: Float[Tensor, " values"]) -> Tensor:
        """Spectra as `_scaled` takes them, not yet of the type that is stored."""
        if not self._is_compact:
            return values
        scale = self._scene.options.value_scale
        values = values if scale is None else values * scale
        if self._kept.kind == "f":
            return values
        whole = values.round().to(torch.int32)
        return torch.where(whole > _LARGEST_INT16, whole - _UINT16_VALUES, whole)

    def pictures(self, of: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Iterator[Tensor]:
        """What a function makes of each view, (H, W), a few rows at a time; on the CPU.

        Args:
            of: From spectra (n, b), alpha and which pixels are valid (n) to n values.
        """
        size = self._width * self._height
        for first in range(0, len(self), size):
            parts = []
            for top, bottom in self._row_ranges():
                start, end = first + top * self._width, first + bottom * self._width
                if self.pool is None:
                    spectra = self.spectra(torch.arange(start, end, device=self.alpha.device)).cpu()
                else:
                    spectra = self._scaled(self._read_range(start, end))
                parts.append(of(spectra, self.alpha[start:end].cpu(), self.valid[start:end]))
            yield torch.cat(parts).view(self._height, self._width)

    def take(self, pixels: Int[Tensor, " R"], first: int, stored: Tensor | None = None) -> DrawnPixels:
        """Some pixels by their index in the block, on any device.

        Args:
            first: Number of the block's first pixel.
            stored: Their values as they are stored, where they were read already.
        """
        pixels = pixels.to(self.alpha.device)
        spectra = self.spectra(pixels) if stored is None else self._scaled(stored).to(self.alpha.device)
        within = pixels % (self._width * self._height)
        return DrawnPixels(
            self.sensor,
            pixels + first,
            self._camera_of[pixels // (self._width * self._height)],
            torch.stack([within % self._width, within // self._width], dim=-1),
            spectra,
            self.alpha[pixels],
        )

    def _stored(self, view: int, part: tuple[slice | np.ndarray, ...]) -> Tensor:
        """Values (pixels, b) of a part of a view.

        Raises:
            SceneError: the file has changed since the scene was checked.
        """
        try:
            cube = self._scene.stored_cube(view, part) if self._is_compact else self._scene.cube(view, part)
        except (OSError, ValueError) as error:
            raise SceneError(
                f"{self._scene.frames[view].cube_path}: the cube can't be read any more ({error}); a scene must stay "
                "as it is while it is trained on"
            ) from error
        return torch.from_numpy(cube.reshape(-1, self.num_channels).view(self._kept))

    def _read_range(self, first: int, last: int) -> Tensor:
        """Values of neighbouring pixels of the block, whole rows at a time."""
        size, width, parts = self._width * self._height, self._width, []
        for row in range(first // size, (last - 1) // size + 1):
            start, end = max(first - row * size, 0), min(last - row * size, size)
            top, bottom = start // width, -(-end // width)
            rows = self._stored(self._views[row], (slice(top, bottom),))
            parts.append(rows[start - top * width : end - top * width])
        return torch.cat(parts)

    def _gathered(self, pixels: Int[Tensor, " R"]) -> Tensor:
        """Values of any pixels of the block, from disk."""
        size = self._width * self._height
        rows = torch.div(pixels, size, rounding_mode="floor")
        found = torch.from_numpy(np.empty((len(pixels), self.num_channels), self._kept))
        for row in rows.unique().tolist():
            chosen = (rows == row).nonzero()[:, 0]
            lines, columns = np.divmod((pixels[chosen] - row * size).numpy(), self._width)
            found[chosen] = self._stored(self._views[row], (lines, columns))
        return found
