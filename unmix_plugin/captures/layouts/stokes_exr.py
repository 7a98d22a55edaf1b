"""One channel of an OpenEXR file that holds Stokes vectors: intensity and opacity of one wavelength.

NeSpoF's files have s0, s1, s2, s3 and maybe alpha, in this order; files of Mitsuba's Stokes integrator have 16 channels
with the intensity in the fifth.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.readers.read_options import ReadOptions
from unmix_plugin.captures.spectral_file import SpectralFile
from unmix_plugin.errors import CaptureError

RAW_CHANNELS, RAW_INTENSITY = 16, 4


def open_intensity(path: Path) -> SpectralFile:
    """The first Stokes component, (H, W, 1).

    Raises:
        CaptureError: the file can't be read, or which channel is s0 can't be told.
    """
    names = _channels(path)
    channel = intensity_channel(names)
    if channel is None:
        raise CaptureError(
            f"{path} has the channels {', '.join(names)}; expected s0 to s3 and maybe alpha, or Mitsuba's 16 channels"
        )
    return open_spectral_file(path, ReadOptions(channel))


def open_opacity(path: Path) -> SpectralFile | None:
    """The alpha channel, (H, W, 1), in [0, 1]; None where there is none."""
    names = _channels(path)
    channel = opacity_channel(names)
    return None if channel is None else open_spectral_file(path, ReadOptions(channel))


def intensity_channel(names: Sequence[str]) -> str | None:
    """The channel with s0, by its name, otherwise by the number of channels.

    >>> intensity_channel(["A", "s0", "s1", "s2", "s3"])
    's0'
    """
    named = [name for name in names if "s0" in name.lower().split(".")]
    if named:
        return named[0]
    if len(names) == RAW_CHANNELS:
        return names[RAW_INTENSITY]
    return names[0] if len(names) in (4, 5) and opacity_channel(names) != names[0] else None


def opacity_channel(names: Sequence[str]) -> str | None:
    """The alpha channel: by its name, otherwise the fifth of five.

    >>> opacity_channel(["s0", "s1", "s2", "s3", "w"])
    'w'
    """
    named = [
        name for name in names if name.lower() in ("a", "alpha") or name.lower().endswith((".a", ".alpha"))
    ]
    if named:
        return named[0]
    return names[-1] if len(names) == 5 else None


def _channels(path: Path) -> list[str]:
    """Names of the channels in the order of the file."""
    import OpenEXR

    try:
        return list(OpenEXR.InputFile(str(path)).header()["channels"])
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise CaptureError(f"{path} can't be read as OpenEXR ({error}); copy it again") from error
