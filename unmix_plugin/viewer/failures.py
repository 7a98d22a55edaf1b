"""Errors on behalf of a client are shown to that client and affect nobody else."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from unmix_plugin.errors import UnmixError

_LOG = logging.getLogger("unmix_plugin.viewer")


@contextmanager
def failures_said(what: str, say: Callable[[str], None]) -> Iterator[None]:
    """Context that lets no error out.

    Args:
        what: What internal errors are reported as; they are logged with their traceback.
        say: Shows a message to the user. Its own errors are logged.
    """
    try:
        yield
    except UnmixError as error:
        _say(what, say, str(error))
    except Exception as error:  # noqa: BLE001 - internal errors must not end the thread that serves everyone
        _LOG.exception(what)
        _say(what, say, f"{what}: {type(error).__name__}: {error}")


def _say(what: str, say: Callable[[str], None], message: str) -> None:
    try:
        say(message)
    except Exception:  # noqa: BLE001 - the page to tell has gone
        _LOG.warning("%s, and the client could not be told: %s", what, message)
