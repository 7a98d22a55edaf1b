"""What every command does around its work: exit codes, and an error shown as a sentence rather than a traceback.

Exit codes: 0 done, 2 the user's error (a bad word, a bad file, a full disk), 130 interrupted, 141 nobody reads what is
printed any more (as after `| head`), 1 a defect of ours.
"""

from __future__ import annotations

import errno
import os
import select
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import NoReturn

from unmix_plugin.errors import UnmixError

DONE, DEFECT, USER_ERROR, INTERRUPTED, UNREAD = 0, 1, 2, 130, 141

_MACHINE_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM})
"""System errors that a user can mend: disk full, quota reached, read-only or forbidden place."""


def run_command(command: Callable[[list[str]], object], arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command and leave the process with the exit code that its end deserves.

    Every command understands `--debug`, which it never sees itself: errors then come with their traceback.

    Args:
        command: Takes the words after the program's name; raises `UnmixError` for what a user can mend.
        arguments: These words; None takes the process's own.
    Raises:
        SystemExit: always, with the exit code; one that the command raises (the parser's 0 or 2) passes through.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    is_debug = "--debug" in words
    try:
        command([word for word in words if word != "--debug"])
        sys.stdout.flush()
    except KeyboardInterrupt:
        _say("interrupted", is_debug)
        sys.exit(INTERRUPTED)
    except Exception as error:  # noqa: BLE001 - the one border where any error becomes an exit code
        if isinstance(error, BrokenPipeError) and _is_unread():
            sys.exit(UNREAD)
        message, status = _verdict(error)
        _say(message, is_debug)
        sys.exit(status)
    sys.exit(DONE)


def _is_unread() -> bool:
    """Whether standard output is a pipe whose reader has gone; what is left in it is then thrown away."""
    try:
        output = sys.stdout.fileno()
    except OSError:
        return False
    if not hasattr(select, "poll"):  # Windows has none
        return False
    watch = select.poll()
    watch.register(output, 0)
    if not watch.poll(0):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), output)  # Python would complain when it ends
    return True


def _verdict(error: Exception) -> tuple[str, int]:
    """What to say about an error, and the exit code."""
    if isinstance(error, UnmixError):
        return f"error: {error}", USER_ERROR
    if isinstance(error, OSError) and error.errno in _MACHINE_ERRORS:
        return f"error: {error}", USER_ERROR
    text = f"{type(error).__name__}: {error}"
    return f"this is a bug in unmix-nerf, please report it with what --debug shows: {text}", DEFECT


def _say(message: str, is_debug: bool) -> None:
    if is_debug:
        traceback.print_exc()
    print(message, file=sys.stderr)
