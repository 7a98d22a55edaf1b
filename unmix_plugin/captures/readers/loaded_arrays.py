"""Arrays of files that can only be read as a whole: the last few are kept, for the next rows of the same image."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

_Key: TypeAlias = tuple[Hashable, ...]
_KEPT_BYTES = 2**28

_kept: OrderedDict[_Key, np.ndarray] = OrderedDict()
_lock = threading.Lock()


def loaded(load: Callable[..., np.ndarray], path: Path, *arguments: Hashable) -> np.ndarray:
    """The array that `load(path, *arguments)` gives; read again only if others came between or the file changed.

    Arrays of 256 MiB together are kept, or one that is larger.
    """
    state = path.stat()
    key: _Key = (load, path.resolve(), arguments, state.st_size, state.st_mtime_ns)
    with _lock:
        if key in _kept:
            _kept.move_to_end(key)
            return _kept[key]
    array: Any = load(path, *arguments)
    array.setflags(write=False)
    with _lock:
        _kept[key] = array
        while len(_kept) > 1 and sum(kept.nbytes for kept in _kept.values()) > _KEPT_BYTES:
            _kept.popitem(last=False)
    return array
