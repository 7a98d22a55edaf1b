"""The pixels of one sensor in memory, as small as they were stored, or a part of them that is renewed from disk.

Cubes of 8 or 16 bits stay as they are in their files and become float32 when pixels are drawn: half or a quarter of the
memory for the same numbers. Cubes of other types are kept as float32, pixels of many bands perhaps as a few numbers
each (`pixel_projection`). Of scenes larger than memory a pool holds some pixels (`pixel_pool`).

Notation: `R` drawn pixels, `b` channels of the sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.pixel_pool import PixelPool
from unmix_plugin.scenes.pixel_projection import Pixels, ProjectedPixels, Projection, Spectra
from unmix_plugin.scenes.reading.cubes import Part
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bad_values import REACH_PX, repaired

_COMPACT_TYPES = ("f2", "u1", "i1", "i2", "u2")
"""Of NumPy, at most half as large as float32."""
_CHUNK_VALUES, _FEWEST_ROWS = 1 << 21, 8
"""Values of a view in single precision at a time, in whole rows: a view of many bands takes a GB."""
_LARGEST_INT16, _UINT16_VALUES = 2**15 - 1, 2**16


@dataclass(frozen=True)
class DrawnPixels:
    """Pixels of one sensor."""

    sensor: int
    """Which of the scene's."""
    numbers: Pixels
    """Of the pixels in the table, each its own."""
    cameras: Pixels
    """Which of the table's views each is of."""
    corners: Int[Tensor, "R 2"]
    """Column and row."""
    spectra: Spectra
    """What the sensor measured, [0, 1]."""
    alpha: Float[Tensor, " R"]
    """Opacity in [0, 1]; 1 where the scene has no alpha."""


class PixelBlock:
    """All pixels of some views of one sensor, view after view, row after row; on disk until they are held."""

    alpha: Float[Tensor, " pixels"]
    valid: Bool[Tensor, " pixels"]
    """Pixels that count, on the CPU."""
    num_bad: int
    """Values that were replaced by what is around them."""

    def __init__(
        self, scene: Scene, views: tuple[int, ...], cameras: tuple[int, ...], device: torch.device
    ) -> None:
        """Read to a device what is known of all pixels of some frames beside their spectra; `cameras` says which view
        of the table each is."""
        self.sensor = scene.frames[views[0]].sensor
        self._scene, self._views, self.cameras = scene, views, cameras
        self._width, self._height = scene.cameras.size(views[0])
        self._size = self._width * self._height
        types = {scene.stored_type(view) for view in views}
        kind = types.pop() if len(types) == 1 else "f4"
        self._is_compact = kind in _COMPACT_TYPES
        self._is_unsigned = kind == "u2"  # PyTorch can't index these, but the same bits as int16
        self._kept = np.dtype("i2" if self._is_unsigned else kind if self._is_compact else "f4")
        self.num_channels = scene.sensors[self.sensor].num_channels
        self.pixel_bytes = self.num_channels * self._kept.itemsize
        """Of a pixel's values as they are stored."""
        self.num_bad = 0
        self.pool: PixelPool | None = None
        self._projected: ProjectedPixels | None = None
        self._values: Tensor | None = None
        ones = torch.ones(1, device=device)
        self.alpha = ones.repeat(len(self)) if scene.has_alpha else ones.expand(len(self))  # without memory
        self.valid = torch.empty(len(self), dtype=torch.bool)
        for row, view in enumerate(views):
            part = slice(row * self._size, (row + 1) * self._size)
            self.valid[part] = torch.from_numpy(scene.valid_mask(view)).flatten()
            opacity = scene.alpha(view)
            if opacity is not None:
                self.alpha[part] = torch.from_numpy(opacity).flatten()
        self._camera_of = torch.tensor(cameras, device=device)

    def __len__(self) -> int:
        return len(self._views) * self._size

    @property
    def num_bytes(self) -> int:
        """Memory that the pixels take."""
        return len(self) * (self.pixel_bytes + 5)

    @property
    def held_bytes(self) -> int:
        """Memory that spectra take once they are read."""
        if self._values is not None:
            return self._values.numel() * self._values.element_size()
        store = self._projected or self.pool
        return 0 if store is None else store.num_bytes

    @property
    def description(self) -> str:
        """What makes it so large."""
        return (
            f"{len(self._views)} views x {self._height} x {self._width} pixels x {self.num_channels} bands x "
            f"{self._kept.itemsize} bytes"
        )

    def hold(self) -> None:
        """Read all values into the memory of the device."""
        blank = torch.from_numpy(np.empty(0, self._kept))
        values = blank.new_empty(len(self), self.num_channels, device=self.alpha.device)
        for first in range(0, len(self), self._size):
            for top, bottom in self._row_ranges():
                part = slice(first + top * self._width, first + bottom * self._width)
                values[part] = self._read_range(part.start, part.stop).to(values.device)
        self._values = values

    def hold_part(self, num_bytes: int) -> None:
        """Leave the values on disk, and hold so much of them for draws."""
        self._values = self._projected = None
        self.num_bad = 0
        if self.valid.any():
            self.pool = PixelPool(self.valid, self.pixel_bytes, num_bytes, self._read_range)

    def hold_projected(
        self, projection: Projection, limits: Float[Tensor, " b"] | None, most_bytes: int | None
    ) -> bool:
        """Read all values, mended with limits, and hold of each pixel its components in a subspace. False, and nothing
        is held: they need more memory than `most_bytes`, which some pixels did not tell."""
        projected = ProjectedPixels(projection, len(self), self.alpha.device, most_bytes)
        for first in range(0, len(self), self._size):
            for top, image, places, values in self._looked_through(first, limits):
                image[places] = values
                if not projected.put(first + top * self._width, image.flatten(0, 1)):
                    return False
        self._projected = projected
        return True

    def mend(self, limits: Float[Tensor, " b"]) -> None:
        """Replace stripes and spikes by what is around them, of values held in memory; limits as of
        `deviation_limits`."""
        assert self._values is not None
        views = self._values.view(-1, self._height, self._width, self.num_channels)
        for row, view in enumerate(views):
            found = [
                (view[top : top + len(image)], places, self._as_stored(values).to(view))
                for top, image, places, values in self._looked_through(row * self._size, limits)
                if len(values)
            ]
            for part, places, values in found:  # after the whole view was looked through as it was measured
                part[tuple(index.to(view.device) for index in places)] = values

    def _looked_through(
        self, first: int, limits: Float[Tensor, " b"] | None
    ) -> Iterator[
        tuple[int, Float[Tensor, "n W b"], tuple[Int[Tensor, " values"], ...], Float[Tensor, " values"]]
    ]:
        """First row, some rows of spectra from there on, places of bad values in these and what is around them; of a
        view, by its first pixel. Without limits none is bad."""
        none = torch.zeros(0, dtype=torch.int64)
        reach = 0 if limits is None else REACH_PX
        for top, bottom in self._row_ranges():
            above, below = max(top - reach, 0), min(bottom + reach, self._height)
            seen = self._neighbours(first + above * self._width, first + below * self._width)
            image = seen.cpu().nan_to_num_().view(below - above, self._width, self.num_channels)
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

    def spectra(self, pixels: Pixels) -> Spectra:
        """Spectra of some pixels in [0, 1], the numbers of `Scene.cube`; only of valid ones."""
        if self._projected is not None:
            return self._projected.spectra(pixels)
        if self._values is not None:
            return self._scaled(self._values[pixels])
        pixels = pixels.cpu()
        rows = pixels // self._size
        found = torch.from_numpy(np.empty((len(pixels), self.num_channels), self._kept))
        for row in rows.unique().tolist():  # from disk
            chosen = (rows == row).nonzero()[:, 0]
            lines, columns = np.divmod((pixels[chosen] - row * self._size).numpy(), self._width)
            found[chosen] = self._stored(self._views[row], (lines, columns))
        return self._scaled(found).to(self.alpha.device)

    def _neighbours(self, first: int, last: int) -> Spectra:
        """The same of pixels that follow each other."""
        if self._projected is not None:
            return self._projected.spectra(torch.arange(first, last, device=self.alpha.device))
        return self._scaled(
            self._read_range(first, last) if self._values is None else self._values[first:last]
        )

    def _scaled(self, values: Tensor) -> Spectra:
        if not self._is_compact:
            return values
        values = (values.view(torch.uint16) if self._is_unsigned else values).float()
        scale = self._scene.options.value_scale
        return (values if scale is None else values.div_(scale)).clamp_(0.0, 1.0)

    def _as_stored(self, values: Float[Tensor, " values"]) -> Tensor:
        """Spectra as `_scaled` takes them, not yet of the type that is stored."""
        scale = self._scene.options.value_scale if self._is_compact else None
        values = values if scale is None else values * scale
        if self._kept.kind == "f":
            return values
        largest = _UINT16_VALUES - 1 if self._is_unsigned else np.iinfo(self._kept).max
        whole = values.round().clamp(max=largest).to(torch.int32)
        return torch.where(whole > _LARGEST_INT16, whole - _UINT16_VALUES, whole)

    def pictures(self, of: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Iterator[Tensor]:
        """What a function makes of each view, (H, W), a few rows at a time, on the CPU; it gets spectra (n, b), alpha
        and which pixels are valid (n)."""
        for first in range(0, len(self), self._size):
            parts = []
            for top, bottom in self._row_ranges():
                start, end = first + top * self._width, first + bottom * self._width
                spectra = self._neighbours(start, end).cpu()
                parts.append(of(spectra, self.alpha[start:end].cpu(), self.valid[start:end]))
            yield torch.cat(parts).view(self._height, self._width)

    def take(self, pixels: Pixels, first: int, stored: Tensor | None = None) -> DrawnPixels:
        """Some pixels by their index in the block, whose first pixel has the number `first`, on any device; `stored`
        are their values as they are stored, where they were read already."""
        pixels = pixels.to(self.alpha.device)
        spectra = self.spectra(pixels) if stored is None else self._scaled(stored).to(self.alpha.device)
        within = pixels % self._size
        return DrawnPixels(
            self.sensor,
            pixels + first,
            self._camera_of[pixels // self._size],
            torch.stack([within % self._width, within // self._width], dim=-1),
            spectra,
            self.alpha[pixels],
        )

    def _stored(self, view: int, part: Part) -> Tensor:
        """Values (pixels, b) of a part of a view. Raises SceneError: the file has changed since the scene was
        checked."""
        try:
            cube = self._scene.stored_cube(view, part) if self._is_compact else self._scene.cube(view, part)
        except (OSError, ValueError) as error:
            path = self._scene.frames[view].cube_path
            raise SceneError(Message.CUBE_CHANGED.sentence(path=path, reason=error)) from error
        return torch.from_numpy(cube.reshape(-1, self.num_channels).view(self._kept))

    def _read_range(self, first: int, last: int) -> Tensor:
        """Values of neighbouring pixels of the block, whole rows at a time."""
        width, parts = self._width, []
        for row in range(first // self._size, (last - 1) // self._size + 1):
            start, end = (min(max(at - row * self._size, 0), self._size) for at in (first, last))
            top, bottom = start // width, -(-end // width)
            rows = self._stored(self._views[row], (slice(top, bottom),))
            parts.append(rows[start - top * width : end - top * width])
        return torch.cat(parts)
