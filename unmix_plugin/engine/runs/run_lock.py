"""One training at a time writes to a run."""

import errno
import os
from pathlib import Path

from unmix_plugin.errors import RunError

try:
    import fcntl
except ImportError:  # Windows: there the lock guards nothing
    fcntl = None  # type: ignore[assignment]


class RunLock:
    """Held from its making to `release`, or to the end of the process, however it ends."""

    def __init__(self, path: Path) -> None:
        """Take the lock; the same process may take it again.

        Raises:
            RunError: another process has it, or the file can't be made.
        """
        self._descriptor: int | None = None
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        try:
            self._descriptor = os.open(path, flags, 0o666)
            if fcntl is not None:
                fcntl.lockf(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if self._descriptor is None or error.errno in (
                errno.EAGAIN,
                errno.EACCES,
            ):  # others: no locks here
                raise RunError(self._refusal(path, error)) from error
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, str(os.getpid()).encode())

    def release(self) -> None:
        """Let others train the run."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    __del__ = release

    def _refusal(self, path: Path, error: OSError) -> str:
        if self._descriptor is None:
            return f"can't write {path}: {error.strerror or error}"
        holder = os.read(self._descriptor, 20).decode(errors="replace")
        return (
            f"another training writes to {path.parent} (process {holder}); stop it first, or wait for its end"
        )
