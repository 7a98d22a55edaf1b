"""What every command does around its work: exit codes, and an error shown as a sentence rather than a traceback.

Exit codes: 0 done; 1 an internal error; 2 the user's error (a bad argument, a bad file, a full disk, too little
memory); 130 Ctrl-C; 141 broken pipe (as after `| head`); 129 and 143 SIGHUP and SIGTERM, after cleaning up.
"""

from __future__ import annotations

import codecs
import errno
import io
import logging
import math
import os
import re
import select
import signal
import stat
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

from unmix_plugin.engine.printing import tell, terminal_text
from unmix_plugin.errors import ConfigError, UnmixError, UnmixWarning

DONE, INTERNAL_ERROR, USER_ERROR, INTERRUPTED, BROKEN_PIPE = 0, 1, 2, 130, 141

_MACHINE_ERRORS = frozenset(
    getattr(errno, name)
    for name in (
        *("ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EACCES", "EPERM", "EIO", "ESTALE", "EMFILE", "ENFILE"),
        *("ENAMETOOLONG", "ELOOP", "ENOTDIR", "EISDIR", "EILSEQ", "ENXIO", "ENODEV", "EBUSY", "ENOTEMPTY"),
    )
    if hasattr(errno, name)
)
"""System errors that a user can mend: a disk that is full or fails, a place that is forbidden, a name that is too long
or leads in a circle, and what is no file or no folder."""

_OUT_OF_MEMORY = re.compile(
    r"OutOfMemoryError|DefaultCPUAllocator|Failed to allocate|CUDA error: out of memory|bad_alloc|"
    r"failed to map segment|[Cc]annot allocate memory|can't start new thread|Resource temporarily unavailable"
)
"""What torch, Warp, the system's loader of libraries and Python say, of which few are MemoryErrors."""

_MEMORY_ADVICE = (
    "Close other programs; use fewer, smaller or more coarsely binned images; lower "
    "--pipeline.model.eval-num-rays-per-chunk in training of unmix-nerf; or take a machine with more memory"
)


def run_command(command: Callable[[list[str]], object], arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a command and leave the process with the matching exit code.

    Every command understands `--debug`, which it never sees itself: errors then come with their traceback.

    Args:
        command: Takes the arguments after the program's name; raises `UnmixError` for what a user can mend.
        arguments: These arguments; None takes the process's own.
    Raises:
        SystemExit: always, with the exit code; one that the command raises (the parser's 0 or 2) passes through.
    """
    argv = [_at_home(word) for word in (sys.argv[1:] if arguments is None else arguments)]
    is_debug = "--debug" in argv
    signals: list[int] = []
    try:
        _ready_streams()
        with _signals_as_exits(signals), _libraries_in_short():
            _refuse_odd_files(argv)
            command([argument for argument in argv if argument != "--debug"])
            sys.stdout.flush()
    except KeyboardInterrupt:
        _say("interrupted", is_debug)
        sys.exit(INTERRUPTED)
    except Exception as error:  # noqa: BLE001 - the one border where any error becomes an exit code
        if isinstance(error, OSError) and _is_output_closed(error):
            sys.exit(BROKEN_PIPE)
        # Wherever C code loses what a handler raises, it may go on without what it was about to do.
        message, status = ("interrupted", 128 + signals[0]) if signals else _verdict(error)
        _say(message, is_debug)
        sys.exit(status)
    sys.exit(128 + signals[0] if signals else DONE)


def _refuse_odd_files(argv: Sequence[str]) -> None:
    """Refuse pipes, sockets and devices among the arguments: who opens one may wait for ever. Raises ConfigError."""
    for path in (part for word in argv for part in (word, word.partition("=")[2]) if part):
        try:
            mode = os.stat(path).st_mode  # noqa: PTH116 - words that are no path at all, too
        except (OSError, ValueError):
            continue
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise ConfigError(
                f"{path} is a pipe, a socket or a device; give a regular file, such as a copy of it"
            )


def _at_home(word: str) -> str:
    """A word in which `~` is the home folder where the shell left it alone: in quotes, and behind `--flag=`."""
    return re.sub(r"^((?:--[\w.-]+=)?)~(?=/|\Z)", lambda found: found[1] + os.path.expanduser("~"), word)  # noqa: PTH111


def _ready_streams() -> None:
    """Streams that take any text: names of files need not be text, and a terminal may know no more than ASCII.

    A stream that was closed before the command began, as by `>&-`, takes what is written and drops it. They are opened
    in the order of their numbers, which a file of ours would have otherwise, and what native code says in it.
    """
    codecs.register_error(_AS_BYTES, _as_bytes)
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: PTH123, SIM115 - for the whole process
        elif name != "stdin" and isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_AS_BYTES)


_AS_BYTES = "unmix-nerf"


def _as_bytes(error: UnicodeError) -> tuple[str | bytes, int]:
    """The bytes that a part of a file's name had; other letters that a stream doesn't know by their numbers."""
    try:
        return codecs.lookup_error("surrogateescape")(error)
    except UnicodeError:
        return codecs.lookup_error("backslashreplace")(error)


@contextmanager
def _libraries_in_short() -> Iterator[None]:
    """Context in which our warnings are lines. Matplotlib says nothing of a home folder that can't be written, where it
    helps itself, and one line of all letters that its font lacks.
    """
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    usual, is_warned = warnings.showwarning, False

    def show(message: Warning | str, *where: Any, **more: Any) -> None:
        nonlocal is_warned
        lacking = re.match(r"Glyph (\d+) .*missing from", str(message))
        if isinstance(message, UnmixWarning):
            _say(f"warning: {message}")
        elif lacking is None:
            usual(terminal_text(str(message)), *where, **more)
        elif not is_warned:
            is_warned, letter = True, chr(int(lacking[1]))
            _say(
                f"warning: figures have boxes in place of letters such as {letter}, which their font lacks; other "
                "files have them. Rename materials or views if that matters",
            )

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = usual


@contextmanager
def _signals_as_exits(noted: list[int]) -> Iterator[None]:
    """Context in which Ctrl-C raises KeyboardInterrupt, and SIGTERM and SIGHUP raise SystemExit, so that whatever was
    begun is cleaned up; `noted` gets the number of each signal.

    While a module is imported nothing is raised, but at once when that is done: imports made by C code lose exceptions,
    and what they were to import is missing afterwards.
    """
    raised_at = -math.inf

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal raised_at
        noted.append(number)
        if (waiting := _frame_outside(frame)) is not frame and waiting is not None:

            def trace(*_: Any) -> None:
                sys.settrace(None)
                waiting.f_trace = None
                stop(number, waiting)

            waiting.f_trace = trace  # called with the next line of the frame that waits for the import
            sys.settrace(lambda *_: None)
        elif time.monotonic() - raised_at > _SAME_SIGNAL_S:  # not one that came by two ways
            raised_at = time.monotonic()
            if number == signal.SIGINT:
                raise KeyboardInterrupt
            sys.exit(128 + number)

    usual = {"SIGTERM": signal.SIG_DFL, "SIGHUP": signal.SIG_DFL, "SIGINT": signal.default_int_handler}
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():  # elsewhere there are no handlers
        for name, handler in usual.items():
            number = getattr(signal, name, None)
            # One that is ignored stays so, as under nohup.
            if number is not None and signal.getsignal(number) in (handler, signal.SIG_DFL):
                before[number] = signal.signal(number, stop)
    try:
        yield
    finally:
        # What comes meanwhile waits: Python would say that it ignores a signal whose handler is being taken away.
        hold = getattr(signal, "pthread_sigmask", lambda *_: None)
        try:
            hold(getattr(signal, "SIG_BLOCK", 0), before)
            for number, handler in before.items():
                signal.signal(number, handler)
        finally:
            hold(getattr(signal, "SIG_UNBLOCK", 0), before)


_SAME_SIGNAL_S = 0.3
"""Within which two signals are one that a terminal and another process sent."""


def _frame_outside(frame: FrameType | None) -> FrameType | None:
    """The innermost frame in which what a handler raises can't get lost: outside of imports, and of what Python calls
    to destroy an object."""
    outside = frame
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith("<frozen importlib") or code.co_name == "__del__":
            outside = frame.f_back
        frame = frame.f_back
    return outside


def _is_output_closed(error: OSError) -> bool:
    """Whether standard output is a pipe whose reader has gone; what is left in it is then thrown away."""
    try:
        output = sys.stdout.fileno()
    except (OSError, ValueError, AttributeError):  # no file, closed, or none at all
        return False
    is_of_pipe = isinstance(error, BrokenPipeError)
    if hasattr(select, "poll"):
        watch = select.poll()
        watch.register(output, 0)
        is_closed = is_of_pipe and bool(watch.poll(0))
    else:  # Windows has none, and may say EINVAL of a pipe without a reader
        is_closed = is_of_pipe or (error.errno == errno.EINVAL and error.filename is None)
    if is_closed:
        os.dup2(os.open(os.devnull, os.O_WRONLY), output)  # Python would complain when it ends
    return is_closed


def _verdict(error: Exception) -> tuple[str, int]:
    """What to say about an error, and the exit code."""
    text = f"{type(error).__name__}: {error}"
    is_loop = isinstance(error, RuntimeError) and "Symlink loop" in text  # so Python says it before 3.13
    if isinstance(error, UnmixError) or is_loop:
        return f"error: {error}", USER_ERROR
    if isinstance(error, OSError) and error.errno in _MACHINE_ERRORS:
        from unmix_plugin.engine.runs.atomic_files import ADVICE

        where = error.filename or "standard output, or a file that was open"
        advice = f"; {ADVICE[error.errno]}" if error.errno in ADVICE else ""
        return f"error: {where}: {error.strerror or error}{advice}", USER_ERROR
    is_of_memory = isinstance(error, MemoryError) or getattr(error, "errno", None) == errno.ENOMEM
    if is_of_memory or _OUT_OF_MEMORY.search(text):
        reason = str(error).strip().splitlines() or ["no more to be had"]
        return f"error: out of memory: {reason[0]}. {_MEMORY_ADVICE}", USER_ERROR
    from unmix_plugin.engine.registry import plugin_at_fault

    if (place := plugin_at_fault(error)) is not None:
        return f"error in the plugin {place}: {text}. --debug shows how it was called", INTERNAL_ERROR
    return f"this is a bug in unmix-nerf, please report it with what --debug shows: {text}", INTERNAL_ERROR


def _say(message: str, is_debug: bool = False) -> None:
    with suppress(OSError):  # the terminal may be gone
        if is_debug:
            tell(traceback.format_exc(), sys.stderr)
        tell(message, sys.stderr)
