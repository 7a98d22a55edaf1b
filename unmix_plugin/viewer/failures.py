"""The border between the viewer's work and its clients: what goes wrong is said, and harms nothing else."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from unmix_plugin.errors import UnmixError

_LOG = logging.getLogger("unmix_plugin.viewer")


@contextmanager
def failures_said(what: str, say: Callable[[str], None]) -> Iterator[None]:
    """Context that no error leaves.

    Args:
        what: Failed, if a defect of ours did; such errors are logged with their traceback.
        say: Takes what a user can mend, or that there is a defect. An error of its own is logged.
    """
    try:
        yield
    except UnmixError as error:
        _say(what, say, str(error))
    except Exception as error:  # noqa: BLE001 - a defect must not end the thread that serves everyone
        _LOG.exception(what)
        _say(what, say, f"{what}: {type(error).__name__}: {error}")


def _say(what: str, say: Callable[[str], None], message: str) -> None:
    try:
        say(message)
    except Exception:  # noqa: BLE001 - whoever should be told has gone
        _LOG.warning("%s, and the client could not be told: %s", what, message)
