"""What not every system has, for the tests that need it."""

import importlib.util
import os
import signal
import sys

import pytest

needs_posix = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs what only POSIX has")
needs_xatlas = pytest.mark.skipif(
    importlib.util.find_spec("xatlas") is None, reason="needs xatlas, of which Python 3.14 has no wheel"
)
SIGNALS_TO_END = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


def most_memory() -> int:
    """The most that this process has held, bytes; 0 where the system does not tell."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
