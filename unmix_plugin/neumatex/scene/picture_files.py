"""One picture of an object: 8-bit pictures, OpenEXR with linear light, .npy cubes.

Notation: `H x W` pixels, `C` colours or bands.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.errors import CaptureError, SceneError, counted
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, map_array, read_array_header
from unmix_plugin.scenes.reading.images import FORMATS, UnreadableImageError, read_colour

LIGHT_SUFFIXES = (".exr", ".npy")
"""Files whose numbers are linear light; others hold 8 bits a channel."""


@dataclass(frozen=True)
class Picture:
    """Numbers of a picture, colours not multiplied by alpha."""

    numbers: Float32[np.ndarray, "H W C"]
    """Linear light, or display values in [0, 1]."""
    alpha: Float32[np.ndarray, "H W"] | None
    """Opacity in [0, 1]; None where the file has none."""
    valid: Bool[np.ndarray, "H W"] | None = None
    """Pixels that count; None where no mask says."""


def read_picture(path: Path, value_scale: float | None = None) -> Picture:
    """Read and check one picture.

    Args:
        path: Its file.
        value_scale: Stored number of a .npy cube that stands for 1; None for floats of light as they are.
    Raises:
        SceneError: it can't be read, has less than 3 colours, or values that are negative or not finite.
    """
    readers = {".exr": _read_exr, ".npy": partial(_read_npy, value_scale=value_scale)}
    try:
        picture = readers.get(path.suffix.lower(), _read_display)(path)
    except (UnreadableArrayError, UnreadableImageError) as error:
        raise SceneError(f"{path} {error}") from error
    except CaptureError as error:
        raise SceneError(str(error)) from error
    except OSError as error:
        raise SceneError(f"{path} can't be read ({error.strerror or error})") from error
    shown = picture.numbers if picture.alpha is None else picture.numbers[picture.alpha > 0]
    if not (np.isfinite(shown).all() and (shown >= 0).all()):
        bad = int((~np.isfinite(shown) | (shown < 0)).any(axis=-1).sum())
        raise SceneError(
            f"{path}: negative values, NaN or infinity in {counted(bad, 'pixel')}; expected light, 0 and up: "
            "repair the picture"
        )
    return picture


def _read_display(path: Path) -> Picture:
    from PIL import Image

    try:
        with Image.open(path, formats=FORMATS) as image:
            size = (image.height, image.width)
    except Exception as error:
        raise UnreadableImageError(
            f"cannot be read as a PNG, JPEG or TIFF picture ({type(error).__name__})"
        ) from error
    pixels = read_colour(path, size).astype(np.float32) / np.float32(255)
    return Picture(pixels[..., :3], pixels[..., 3] if pixels.shape[2] == 4 else None)


def _read_exr(path: Path) -> Picture:
    from unmix_plugin.captures.readers.exr import open_exr
    from unmix_plugin.captures.readers.read_options import ReadOptions

    everything = (slice(None), slice(None))
    file = open_exr(path, ReadOptions())
    numbers = np.array(file.read_part(*everything), dtype=np.float32, order="C")
    if numbers.shape[2] < 3:
        raise SceneError(f"{path}: has {numbers.shape[2]} channels of colour; expected R, G and B")
    if "A" not in file.metadata.get("other_channels", []):
        return Picture(numbers, None)
    alpha = open_exr(path, ReadOptions(dataset="A")).read_part(*everything)
    return Picture(numbers, np.asarray(alpha, dtype=np.float32)[..., 0].clip(0, 1))


def _read_npy(path: Path, value_scale: float | None) -> Picture:
    header = read_array_header(path)
    if len(header.shape) != 3 or header.shape[2] < 3:
        raise SceneError(
            f"{path}: holds numbers of shape {header.shape}; expected rows x columns x 3 or more colours"
        )
    if value_scale is None and header.dtype.kind != "f":
        raise SceneError(
            f"{path}: holds {header.dtype}; expected floats, or 'value_scale' in transforms.json: the number that "
            "stands for 1"
        )
    numbers = np.array(map_array(path), dtype=np.float32, order="C")
    return Picture(numbers if value_scale is None else numbers / np.float32(value_scale), None)
