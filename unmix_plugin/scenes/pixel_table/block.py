"""The pixels of one sensor in memory, as small as they were stored.

Cubes of 8 or 16 bits stay as they are in their files and become float32 when pixels are drawn: half or a quarter of the
memory for the same numbers. Cubes of other types are kept as float32.

Notation: `b` channels of the sensor, `R` drawn pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.pixel_table.pool import PixelPool
from unmix_plugin.scenes.pixel_table.projection import ProjectedPixels
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.spectral.bad_values import repaired
from unmix_plugin.spectral.subspace import SpectralSubspace

COMPACT_TYPES = ("f2", "u1", "i1", "i2", "u2")
"""Of NumPy, at most half as large as float32."""
_CHUNK_VALUES = 1 << 23
"""Values of a view in single precision at a time: a view of many bands takes a GB."""
_LARGEST_INT16, _UINT16_VALUES = 2**15 - 1, 2**16


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
        self._is_compact = kind in COMPACT_TYPES
        self._is_unsigned = kind == "u2"  # PyTorch can't index these, but the same bits as int16
        self._kept = np.dtype("i2" if self._is_unsigned else kind if self._is_compact else "f4")
        self.num_channels = scene.sensors[self.sensor].num_channels
        self.num_bad = 0
        self.pool: PixelPool | None = None
        self._projected: ProjectedPixels | None = None
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
            values[row] = self._stored(view, ())
        self._values = values.flatten(0, 1)

    def hold_part(self, num_bytes: int) -> None:
        """Leave the values on disk, and hold so much of them for draws."""
        if self.valid.any():
            pixel_bytes = self.num_channels * self.value_bytes
            self.pool = PixelPool(self.valid, pixel_bytes, num_bytes, self._read_range)

    def hold_projected(self, subspace: SpectralSubspace, limits: Float[Tensor, " b"] | None) -> None:
        """Read all values, and hold of each pixel its components in a subspace.

        Args:
            limits: As `mend` takes them; None replaces nothing.
        """
        num_pixels = self._width * self._height
        projected = ProjectedPixels(subspace, len(self), self.num_channels, self._camera_of.device)
        for row, view in enumerate(self._views):
            spectra = self._scaled(self._stored(view, ()))
            if limits is not None:
                image = spectra.view(self._height, self._width, self.num_channels)
                is_bad, values = repaired(image, limits)
                image[is_bad] = values
                self.num_bad += len(values)
            projected.put(row * num_pixels, spectra)
        self._projected = projected

    def mend(self, limits: Float[Tensor, " b"]) -> None:
        """Replace stripes and spikes by what is around them, of values held in memory.

        Args:
            limits: As `deviation_limits` gives them.
        """
        assert self._values is not None
        size = self._width * self._height
        shape = (self._height, self._width, self.num_channels)
        for first in range(0, len(self), size):
            image = self._scaled(self._values[first : first + size]).cpu().view(shape)
            is_bad, values = repaired(image, limits.cpu())
            if len(values):
                view = self._values[first : first + size].view(shape)
                view[is_bad.to(view.device)] = self._as_stored(values).to(view)
                self.num_bad += len(values)

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
        if self._is_unsigned:
            values = values.to(torch.int32) & 0xFFFF
        values, scale = values.float(), self._scene.options.value_scale
        return (values if scale is None else values / scale).clamp(0.0, 1.0)

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
        step = self._width * max(1, _CHUNK_VALUES // (self._width * self.num_channels))
        for first in range(0, len(self), size):
            parts = []
            for start in range(first, first + size, step):
                end = min(start + step, first + size)
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
