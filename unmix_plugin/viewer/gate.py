"""Who may use the viewer: pages of its own origin, with the word where one is asked for, and not too many at once."""

from __future__ import annotations

import hmac
import threading
import time
from collections.abc import Mapping
from urllib.parse import urlsplit

MOST_CLIENTS = 16
"""Pages that are served at once."""

_LEAST_INTERVAL_S = 0.5
"""Between two tries of the word, over all clients: nobody gets through a dictionary."""


class Gate:
    """Checks words, slowly."""

    def __init__(self, token: str | None) -> None:
        """
        Args:
            token: The word; None lets everyone in.
        """
        self._token = token
        self._lock = threading.Lock()
        self._tried_at = -_LEAST_INTERVAL_S

    @property
    def is_open(self) -> bool:
        """Whether no word is asked for."""
        return self._token is None

    def admits(self, word: str) -> bool:
        """Whether a word is the right one; always no if the last try was a moment ago."""
        if self._token is None:
            return True
        with self._lock:
            now = time.monotonic()
            is_too_soon = now - self._tried_at < _LEAST_INTERVAL_S
            self._tried_at = now
        is_right = hmac.compare_digest(word.encode(), self._token.encode())
        return is_right and not is_too_soon


def is_of_another_site(headers: Mapping[str, str]) -> bool:
    """Whether a connection was opened by a page that another server sent: browsers let any page try.

    Args:
        headers: Of the request that opened it; names in any case.
    """
    known = {name.lower(): value for name, value in headers.items()}
    origin, host = known.get("origin"), known.get("host")
    if origin is None or host is None:
        return False  # no browser: those always say where a page is from
    return urlsplit(origin).netloc.lower() != host.lower()
