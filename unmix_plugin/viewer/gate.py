"""Who may use the viewer: pages of its own site, with the token where one is asked for, and not too many at once."""

from __future__ import annotations

import hmac
import ipaddress
import socket
import threading
from collections.abc import Mapping
from urllib.parse import urlsplit

from unmix_plugin.viewer.address import ANYWHERE

MOST_CLIENTS = 16
"""Pages that are served at once."""

MOST_WAITING = 16
"""Pages from one address that may be asked for the token at once."""


class Gate:
    """Checks tokens, one at a time for each address, so that nobody gets through a dictionary.

    A page's guess waits for its turn; the right token is never turned down because others guessed wrong.
    """

    def __init__(self, token: str | None) -> None:
        """
        Args:
            token: What pages must give; None lets everyone in.
        """
        self._token = token
        self._lock = threading.Lock()
        self._address_of: dict[int, str] = {}
        self._guesses: dict[int, str] = {}

    @property
    def is_open(self) -> bool:
        """Whether no token is asked for."""
        return self._token is None

    def enter(self, page: int, address: str) -> bool:
        """Note a page that is asked for the token; False if too many from its address are already."""
        with self._lock:
            if list(self._address_of.values()).count(address) >= MOST_WAITING:
                return False
            self._address_of[page] = address
            return True

    def leave(self, page: int) -> None:
        """Forget a page and its guess."""
        with self._lock:
            self._address_of.pop(page, None)
            self._guesses.pop(page, None)

    def guess(self, page: int, word: str) -> None:
        """Queue a page's guess; a later one of the same page replaces it in its place."""
        with self._lock:
            if page in self._address_of:
                self._guesses[page] = word

    def verdicts(self) -> dict[int, bool]:
        """Check the oldest guess from each address: whether it is right, by page. To be called at a steady pace."""
        with self._lock:
            chosen: dict[str, int] = {}
            for page in self._guesses:
                chosen.setdefault(self._address_of[page], page)
            return {page: self._is_token(self._guesses.pop(page)) for page in chosen.values()}

    def _is_token(self, word: str) -> bool:
        return self._token is None or hmac.compare_digest(word.encode(), self._token.encode())


def is_own_page(headers: Mapping[str, str] | None, host: str) -> bool:
    """Whether a connection comes from a page that this server sent, and not from one of another site.

    Browsers let any page connect, and a site can let its own name point here (DNS rebinding), so the name must be one
    that only this machine has: a loopback name, an IP address, or that of `host`.

    Args:
        headers: Of the request that opened the connection, names in any case; None where they can't be read.
        host: Where the server listens.
    """
    if headers is None:
        return False
    known = {name.lower(): value.lower() for name, value in headers.items()}
    if "origin" not in known:
        return True  # not a browser: those always send it
    asked = known.get("host", "")
    return urlsplit(known["origin"]).netloc == asked and _is_own_name(urlsplit(f"//{asked}").hostname, host)


def _is_own_name(name: str | None, host: str) -> bool:
    if name is None:
        return False
    own = {"localhost", host.lower()}
    if host in ANYWHERE:
        own |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    if name in own:
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
