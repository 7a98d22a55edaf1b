"""Pictures of an object with their cameras, as a transforms.json lists them: 8-bit pictures, OpenEXR with linear light,
.npy cubes.

Notation: `N` pictures of `H x W` pixels, `C` colours or bands.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from unmix_plugin.engine import Cameras
from unmix_plugin.errors import CaptureError, SceneError
from unmix_plugin.formats.files import hash_of
from unmix_plugin.neumatex.fit.tone import ToneMapping
from unmix_plugin.neumatex.tracing.light_files import read_exr, require_light
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, map_array, read_array_header
from unmix_plugin.scenes.reading.entries import FrameEntry, SceneEntry, at_sizes
from unmix_plugin.scenes.reading.faults import Faults, resolve_path
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_colour, read_mask
from unmix_plugin.scenes.reading.loader import distinct_names
from unmix_plugin.scenes.scene import Normalisation

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
    wavelengths_nm: tuple[float, ...] | None = None
    """Of the bands, as the file says; None where it says none."""

    @property
    def has_alpha(self) -> bool:
        """Whether some pixel is not opaque."""
        return self.alpha is not None and bool((self.alpha < 1).any())

    @property
    def opacity(self) -> Float32[np.ndarray, "H W"]:
        """Alpha; 1 where the picture has none, 0 where a mask says that pixels do not count."""
        alpha = np.ones(self.numbers.shape[:2], np.float32) if self.alpha is None else self.alpha
        return alpha if self.valid is None else alpha * self.valid


def read_picture(path: Path, value_scale: float | None = None) -> Picture:
    """Read and check one picture; colours are 0 where alpha is, where they mean nothing.

    Args:
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
    require_light(path, shown)
    if picture.alpha is None:
        return picture
    return replace(picture, numbers=np.where(picture.alpha[..., None] > 0, picture.numbers, np.float32(0)))


def _read_display(path: Path) -> Picture:
    pixels = read_colour(path, None).astype(np.float32) / np.float32(255)
    return Picture(pixels[..., :3], pixels[..., 3] if pixels.shape[2] == 4 else None)


def _read_exr(path: Path) -> Picture:
    from unmix_plugin.captures.readers.exr import channel_names

    numbers, names, nm = read_exr(path)
    layers = {name[:-1] for name in names if {name[:-1] + colour for colour in "RGB"} <= set(names)}
    layer, alpha = min(layers, default=""), None
    is_clear = "" in layers or len(layers) == 1 or (not layers and len(names) > 3)
    if len(names) < 3 or (nm is None and not is_clear):
        raise SceneError(f"{path}: has the channels {', '.join(names)}; expected R, G and B, of one layer")
    if nm is None and layers:
        numbers = numbers[..., [names.index(layer + colour) for colour in "RGB"]]
    if f"{layer}A" in channel_names(path):  # outside of the data window nothing is
        alpha = np.nan_to_num(read_exr(path, f"{layer}A")[0][..., 0]).astype(np.float32).clip(0, 1)
    return Picture(
        numbers.astype(np.float32), alpha, wavelengths_nm=None if nm is None else tuple(nm.tolist())
    )


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


@dataclass(frozen=True)
class _PictureFiles:
    """The files of one picture."""

    colours: Path
    """What holds its colours."""
    opacity: Path | None
    """What holds its alpha, where that is another file."""
    mask: Path | None
    """Black where pixels do not count."""
    value_scale: float | None
    """Stored number of a .npy array that stands for 1."""

    def read(self) -> Picture:
        """The picture; colours of a cube whose alpha is apart are divided by it."""
        picture = read_picture(self.colours, self.value_scale)
        height, width = picture.numbers.shape[:2]
        if self.mask is not None:
            try:
                picture = replace(picture, valid=read_mask(self.mask, (height, width)))
            except UnreadableImageError as error:
                raise SceneError(f"{self.mask} {error}") from error
        alpha = None if self.opacity is None else read_picture(self.opacity).alpha
        if alpha is None:
            return picture
        if alpha.shape != (height, width):
            raise SceneError(
                f"{self.opacity}: has {alpha.shape[1]} x {alpha.shape[0]} pixels, its cube {self.colours.name} has "
                f"{width} x {height}; give both one size"
            )
        numbers = picture.numbers / np.maximum(alpha, np.float32(1e-3))[..., None]
        return replace(picture, numbers=numbers, alpha=alpha)


@dataclass(frozen=True)
class PosedPictures:
    """Pictures and their cameras, read when asked for."""

    names: list[str]
    """Short, distinct, fit for file names."""
    files: tuple[_PictureFiles, ...]
    cameras: Cameras
    """Model space, one a picture."""
    tone: ToneMapping
    """What the numbers are of light."""
    num_colours: int
    """C."""
    wavelengths_nm: tuple[float, ...] | None
    """Of the bands, as the files say; None where they say none."""

    def __len__(self) -> int:
        return len(self.files)

    def read(self, index: int) -> Picture:
        """One picture, checked. Raises SceneError: it can't be read, or its size has changed."""
        picture, (width, height) = self.files[index].read(), self.cameras.size(index)
        if picture.numbers.shape[:2] != (height, width):
            raise SceneError(f"{self.files[index].colours} has changed since it was first read; start again")
        return picture

    @cached_property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of each file, by its picture's name and what else it holds of it."""
        return {
            f"{name}{what}": hash_of(path)
            for name, files in zip(self.names, self.files, strict=True)
            for what, path in (("", files.colours), (" alpha", files.opacity), (" mask", files.mask))
            if path is not None
        }


def read_posed_pictures(
    root: Path, entry: SceneEntry, frame: Normalisation, tone: ToneMapping | None
) -> PosedPictures:
    """Find and check the pictures of a transforms.json.

    Args:
        entry: Its content, without faults.
        frame: From the space of its poses to model space.
        tone: What it says of the pictures; None for light in files that hold light, an unknown response in others.
    Raises:
        SceneError: pictures are missing or malformed; all their faults in one message.
    """
    faults = Faults(root)
    located = [_locate(root, one, entry.keys.value_scale, faults) for one in entry.frames]
    faults.raise_if_any()
    files = [one for one in located if one is not None]
    sizes, colours = [], set()
    for one in files:
        try:
            picture = one.read()
        except SceneError as error:
            faults.add(str(root), str(error).replace(f"{root}/", ""))
            continue
        sizes.append(picture.numbers.shape[:2])
        colours.add((picture.numbers.shape[2], picture.wavelengths_nm))
    kinds = {one.colours.suffix.lower() in LIGHT_SUFFIXES for one in files}
    if len(kinds) > 1 or len(colours) > 1:
        faults.add(
            "frames",
            "mix pictures of light (.exr, .npy) and others, or of different numbers of colours or wavelengths; give "
            "one kind",
        )
    faults.raise_if_any()
    ((count, wavelengths),) = colours
    for one in entry.frames:
        if one.bands not in (None, tuple(range(count))):
            faults.add(
                one.where,
                f"'bands' does not list all {count} bands of its picture in order; sort them as 'wavelengths' are, and "
                "leave the key out",
            )
    entry = at_sizes(entry, sizes, faults)
    faults.raise_if_any()
    cameras, usual = entry.cameras(sizes, frame), "linear" if kinds == {True} else "camera"
    names = distinct_names([one.colours.relative_to(root).as_posix() for one in files])
    return PosedPictures(names, tuple(files), cameras, tone or usual, count, wavelengths)


def _locate(root: Path, frame: FrameEntry, value_scale: float | None, faults: Faults) -> _PictureFiles | None:
    """The files of a frame; None with noted faults where one is missing."""
    if "responses_path" in frame.paths:
        faults.add(
            frame.where,
            "has 'responses_path', which is not followed here: bands are taken to be narrow; give cubes of the bands "
            "of 'wavelengths', and leave the key out",
        )
    keys = [key for key in ("hyperspectral_file_path", "file_path", "mask_path") if key in frame.paths]
    found = {key: resolve_path(root, frame.paths[key], None, frame.where, faults) for key in keys}
    mask = found.pop("mask_path", None)
    colours, *others = found.values()
    opacity = others[0] if others else None
    return None if colours is None else _PictureFiles(colours, opacity, mask, value_scale)
