"""What can go wrong that is not our bug: one hierarchy, one clear message each.

A message says what, where (file, frame, band), found against expected, and what to do. Commands print it without a
traceback and exit with status 2; anything else that escapes is an internal error and exits with status 1.
"""

import difflib
import re
from collections.abc import Iterable, Sequence
from importlib import metadata


class UnmixError(Exception):
    """Base of every error whose cause a user can mend."""


class CaptureError(UnmixError):
    """Files of an instrument are missing, damaged, of an unknown kind, or contradict each other."""


class SceneError(UnmixError):
    """The input scene is missing, malformed or contradicts itself."""


class RunError(UnmixError):
    """A run folder is missing, half-written, from a newer version, or can't be written."""


class ConfigError(UnmixError):
    """A setting or a command-line word is unknown, impossible, or doesn't fit this machine or scene."""


class SpectrumError(UnmixError):
    """Spectra, wavelengths or endmembers do not fit each other or the request."""


class UnmixWarning(UserWarning):
    """What a user should know of a result; commands show it as a line."""


def did_you_mean(word: str, known: Iterable[str], likeness: float = 0.6, form: str = "{}") -> str:
    """A question for a message that names what may have been meant; empty if nothing is near.

    Args:
        likeness: How near is near, from 0 to 1 for the same; lower among few names that hardly resemble each other.
        form: How the question is put in its message, {} being the question; empty without one.

    >>> did_you_mean("segmentaton", ["segmentation", "depth"])
    'did you mean segmentation?'
    """
    near = difflib.get_close_matches(word, list(known), n=3, cutoff=likeness)
    return form.format(f"did you mean {' or '.join(near)}?") if near else ""


def install_hint(extra: str) -> str:
    """The command that installs what an extra of this package needs; the same for a clone, a release and every shell.

    >>> install_hint("lmrm")
    'python -m pip install "diffusers>=..."'
    """
    try:
        needed = [line.partition(";") for line in metadata.requires("unmix-nerf") or ()]
    except metadata.PackageNotFoundError:  # the sources alone
        needed = []
    found = [name.strip() for name, _, marker in needed if re.search(rf"extra == .{extra}\b", marker)]
    return " ".join(["python -m pip install", *(f'"{name}"' for name in found or [f"unmix-nerf[{extra}]"])])


def counted(number: int, noun: str) -> str:
    """A number of things in words; the noun's plural ends with s.

    >>> counted(1, "view"), counted(12000, "pixel")
    ('1 view', '12000 pixels')
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def name_some(names: Sequence[str], most: int = 3) -> str:
    """A few names for a message, and how many more there are.

    >>> name_some(["a", "b", "c"], most=2)
    'a, b and 1 more'
    """
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
