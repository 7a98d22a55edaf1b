"""How the process keeps memory that it will need again."""

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # names of mallopt's settings in malloc.h
_KEPT_BYTES = 2**30


def keep_freed_memory() -> None:
    """Let the C library keep large freed blocks instead of handing them back to the system.

    A training step frees and takes blocks of a few MB hundreds of times; by default glibc returns each, and the page
    faults of taking it again took 40 % of the time of a field evaluation on two cores. Does nothing where the C library
    is another.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
    mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
