"""Takes what only POSIX has from every Python process that finds this folder in PYTHONPATH: `make test-portable`.

Windows has neither these modules, functions and signals, nor, by default, a console that takes every letter.
"""

import contextlib
import os
import select
import signal
import sys

with contextlib.suppress(ImportError):
    import filelock  # noqa: F401 - it has locks on Windows, too
for module in ("fcntl", "grp", "pty", "pwd", "resource", "termios"):
    sys.modules[module] = None  # type: ignore[assignment] - an import of it then fails
for home, names in (
    (os, ("O_NOFOLLOW", "fork", "forkpty", "killpg", "mkfifo", "openpty", "setsid")),
    (select, ("epoll", "poll")),
    (signal, ("SIGALRM", "SIGHUP", "SIGQUIT", "SIGUSR1", "SIGUSR2", "alarm", "setitimer")),
):
    for name in names:
        vars(home).pop(name, None)
os.environ["PYTHONIOENCODING"] = "cp1252"
