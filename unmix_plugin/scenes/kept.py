"""What was judged of a scene, kept in the user's cache by content: a second start need not judge it again.

A judgement is kept under a hash of all that it depends on: what its caller names, such as hashes of the scene's files
and options, the code of this package and the versions of the libraries that judge. So it is never out of date. What
can't be read or written is judged again, without a word: it costs time alone.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import torch
from torch import Tensor

from unmix_plugin.engine.runs.replacing import temporary_name
from unmix_plugin.errors import SceneError

_LIBRARIES = ("numpy", "scipy", "scikit-image", "torch")
_MOST_KEPT = 100
"""Judgements; beyond, those that were not used for longest go."""
_SUFFIX = ".judged"
_Judged = TypeVar("_Judged")


def user_cache() -> Path:
    """Where generated data is kept, by the XDG base directory specification: XDG_CACHE_HOME counts only if absolute.
    Raises SceneError: it is not set, and there is no home folder."""
    configured = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        return (configured if configured.is_absolute() else Path.home() / ".cache") / "unmix-nerf"
    except RuntimeError as error:  # as in a container, for a user that it does not know
        raise SceneError(
            "there is no home folder to keep the demo scene in; set HOME or XDG_CACHE_HOME to a folder that can be "
            "written, or write the scene with unmix-demo-scene DIR and train on that"
        ) from error


def judged_once(kind: type[_Judged], given: Mapping[str, Any], judge: Callable[[], _Judged]) -> _Judged:
    """What `judge` returns, or what it returned when it was given the same.

    Args:
        kind: Its class: a dataclass of plain values, arrays, tensors and other such dataclasses.
        given: All that it depends on beside the code, by name; each value's `repr` shows whatever matters.
    """
    try:
        path = user_cache() / "judged" / f"{_key(kind, given)}{_SUFFIX}"
    except SceneError:  # no home folder
        return judge()
    with suppress(OSError, zlib.error, msgspec.MsgspecError, ValueError, KeyError, TypeError):
        packed = zlib.decompress(path.read_bytes())
        found = msgspec.msgpack.decode(packed, type=kind, dec_hook=_array)
        os.utime(path)
        return found
    found = judge()
    packed = zlib.compress(msgspec.msgpack.encode(found, enc_hook=_values), level=1)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        staged = temporary_name(path)
        staged.write_bytes(packed)
        staged.replace(path)
        by_use = sorted(path.parent.glob(f"*{_SUFFIX}"), key=lambda kept: kept.stat().st_mtime, reverse=True)
        for kept in by_use[_MOST_KEPT:]:
            kept.unlink()
    return found


def _key(kind: type, given: Mapping[str, Any]) -> str:
    depends_on = (kind.__qualname__, _code(), sorted((name, repr(value)) for name, value in given.items()))
    return hashlib.sha256(repr(depends_on).encode()).hexdigest()[:32]


@cache
def _code() -> str:
    """Which code judges: size and time of the package's modules, and versions of the libraries."""
    package = Path(__file__).parents[1]
    modules = [(path.relative_to(package), path.stat()) for path in sorted(package.rglob("*.py"))]
    files = [(str(path), stat.st_size, stat.st_mtime_ns) for path, stat in modules]
    return repr((files, [version(name) for name in _LIBRARIES]))


def _values(found: Any) -> Any:
    """What msgspec has no way to write: tensors, arrays and numpy's numbers."""
    if isinstance(found, np.generic):
        return found.item()
    array = found.numpy() if isinstance(found, Tensor) else np.asarray(found)
    return [array.dtype.str, list(array.shape), array.tobytes()]


def _array(kind: Any, written: Any) -> np.ndarray | Tensor:
    """The reverse, by the kind that a field has."""
    dtype, shape, values = written
    array = np.frombuffer(values, dtype=dtype).reshape(shape).copy()
    return torch.from_numpy(array) if kind.array_type is Tensor else array
