"""Who may use the viewer, judged when a request comes in and before a page can send anything.

A page is let in by the token, where there is one, and always only if it is this server's own: browsers let any page of
any site connect, so `Origin` and `Host` tell pages apart. The token is given once, to a small page that asks for it; a
cookie stands for it from then on.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import hmac
import html
import ipaddress
import secrets
import socket
import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from http import HTTPStatus
from urllib.parse import urlsplit

ANYWHERE = ("0.0.0.0", "::", "")
"""Hosts that mean every address of this machine."""

MOST_PAGES = 16
"""Pages that are served at once."""

_MOST_WAITING, _MOST_WAITING_IN_ALL = 16, 64
"""Guesses that may wait for their turn at once: from one address, and from all of them."""

_MOST_KINDS, _LONGEST_WARNING = 16, 400


class WarningsOfStrangers:
    """Warnings that strangers cause: one of each kind, few kinds in all, none long, or they would fill the disk."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._kinds = say, set[str]()

    def warn(self, kind: str, text: str) -> None:
        """Say a line, unless one of its kind was said."""
        if kind not in self._kinds and len(self._kinds) < _MOST_KINDS:
            self._kinds.add(kind)
            self._say(f"warning: {text}"[:_LONGEST_WARNING])


@dataclass(frozen=True)
class _Refusal:
    """What is answered in place of the page or the connection that was asked for."""

    status: HTTPStatus
    text: str
    headers: Mapping[str, str] = field(default_factory=lambda: {"Content-Type": "text/plain; charset=utf-8"})


class _GuessQueue:
    """Guesses of the token, one every `guess_s`: each address that guesses has its turn before one of them has
    another, so that a crowd of guesses from one address does not keep the owner out."""

    def __init__(self, guess_s: float) -> None:
        self._guess_s = guess_s
        self._waiting: list[tuple[int, str, object]] = []
        """In which round each guess has its turn, and the network that it comes from."""
        self._round, self._next_at = 0, 0.0

    async def turn(self, address: str) -> bool:
        """Wait for the turn of a guess; False if too many wait already."""
        network = _network_of(address)
        rounds = [number for number, other, _ in self._waiting if other == network]
        if len(rounds) >= _MOST_WAITING or len(self._waiting) >= _MOST_WAITING_IN_ALL:
            return False
        mine = (max([self._round, *rounds]) + 1, network, object())
        self._waiting.append(mine)
        if self._waiting == [mine]:
            self._next_at = max(self._next_at, time.monotonic() + self._guess_s)
        try:
            # The first of the least round; Python's min takes the first of equals.
            while min(self._waiting, key=lambda one: one[0]) is not mine or time.monotonic() < self._next_at:
                await asyncio.sleep(self._guess_s / 10)
        finally:
            self._waiting.remove(mine)
        self._round, self._next_at = mine[0], time.monotonic() + self._guess_s
        return True


def _network_of(address: str) -> str:
    """What one guesser has of addresses: one of IPv4, but 2^64 of IPv6."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    return str(found if found.version == 4 else ipaddress.ip_network((found, 64), strict=False))


class Authentication:
    """Judges requests and counts pages; used by the server's event loop alone."""

    def __init__(
        self,
        host: str,
        token: str | None,
        say: Callable[[str], None] = lambda _: None,
        *,
        guess_s: float = 0.5,
        room_s: float = 2.0,
    ) -> None:
        """`host` is where the server listens; `guess_s` are seconds between two guesses of the token, of all addresses
        together, so that nobody gets through a dictionary; `room_s` is how long a page waits for a place: one that is
        loaded again comes before its old connection has gone."""
        self._host, self._warnings = host, WarningsOfStrangers(say)
        self._token = None if token is None else token.encode()
        self._cookie_value = secrets.token_urlsafe(32)
        self._pages: set[Hashable] = set()
        self._guesses, self._room_s = _GuessQueue(guess_s), room_s

    async def refusal(
        self, page: Hashable, headers: Mapping[str, str], address: str, port: int
    ) -> _Refusal | None:
        """What to answer to a request instead of what it asks for; None if it is let in.

        A connection that is let in takes a place, to be given back by `leave`; `page` stands for it. Names of `headers`
        are in lower case; `address` is where the request comes from, `port` where the server listens: the cookie's name
        has it, since browsers share cookies between ports.
        """
        opens = headers.get("upgrade", "").lower() == "websocket"
        cookie = f"unmix-nerf-{port}"
        if self._token is not None and not self._is_known(headers, cookie):
            if "authorization" in headers:
                refusal = await self._check(headers["authorization"], address)
                if refusal is not None:
                    return refusal
            elif opens:
                return _Refusal(HTTPStatus.UNAUTHORIZED, "load this page again and give the viewer's token")
            else:
                return _Refusal(HTTPStatus.UNAUTHORIZED, _ASKING, _HTML)
            if not opens:
                value = f"{cookie}={self._cookie_value}; Path=/; HttpOnly; SameSite=Strict"
                return _Refusal(HTTPStatus.OK, "welcome", {"Set-Cookie": value})
        if not _is_own_page(headers, self._host, self._token is not None):
            return self._foreign(headers.get("origin", headers.get("host", "unknown")), opens)
        if not await self._has_room(page, opens):
            reason = f"{MOST_PAGES} pages are open already: close one and load this page again"
            return _Refusal(HTTPStatus.SERVICE_UNAVAILABLE, reason if opens else _page(reason), _HTML)
        return None

    def leave(self, page: Hashable) -> None:
        """Give back the place of a connection, if it has one."""
        self._pages.discard(page)

    def _is_known(self, headers: Mapping[str, str], cookie: str) -> bool:
        # By hand: the standard reader drops all cookies where another program's on this host is malformed.
        pairs = (part.strip().partition("=") for part in headers.get("cookie", "").split(";"))
        wanted = self._cookie_value.encode()
        return any(
            name == cookie and hmac.compare_digest(value.encode("utf-8", "replace"), wanted)
            for name, _, value in pairs
        )

    async def _check(self, given: str, address: str) -> _Refusal | None:
        """Check the token when it is its turn; why it is turned down, None if it is right."""
        if not await self._guesses.turn(address):
            return _Refusal(
                HTTPStatus.TOO_MANY_REQUESTS, "Too many guesses are waiting: try again in some seconds."
            )
        assert self._token is not None
        is_right = hmac.compare_digest(_given_word(given), self._token)
        return None if is_right else _Refusal(HTTPStatus.UNAUTHORIZED, "That is not the token.")

    def _foreign(self, site: str, opens: bool) -> _Refusal:
        site = "".join(character for character in site[:100] if character.isprintable())
        self._warnings.warn(
            site,
            f"a page of another site ({site}) tried to use the viewer and was refused; if it is yours, "
            "start the viewer with --viewer.token",
        )
        reason = "this page is from another site; the viewer must be started with --viewer.token to serve it"
        return _Refusal(HTTPStatus.FORBIDDEN, reason if opens else _page(reason), _HTML)

    async def _has_room(self, page: Hashable, opens: bool) -> bool:
        until = time.monotonic() + self._room_s
        while len(self._pages) >= MOST_PAGES:
            if time.monotonic() > until:
                return False
            await asyncio.sleep(0.05)
        if opens:
            self._pages.add(page)
        return True


def _given_word(authorization: str) -> bytes:
    """The password of an `Authorization: Basic` header; empty if there is none."""
    scheme, _, coded = authorization.partition(" ")
    try:
        word = base64.b64decode(coded.strip(), validate=True)
    except (binascii.Error, ValueError):
        return b""
    return word.partition(b":")[2] if scheme.lower() == "basic" else b""


def _is_own_page(headers: Mapping[str, str], host: str, has_token: bool = False) -> bool:
    """Whether a request comes from a page that this server sent, and not from one of another site.

    A site can let its own name point here (DNS rebinding), so without a token the name must be one that only this
    machine has: a loopback name, an IP address, or that of `host`, where the server listens. With a token the viewer
    may stand behind a proxy, under any name and with TLS; but the page must still be of the host that it connects to.
    """
    asked = headers.get("host", "").lower()
    origin = headers.get("origin")
    try:
        name = urlsplit(f"//{asked}").hostname
        site = None if origin is None else urlsplit(origin.lower())
        place = None if site is None else site.netloc
    except ValueError:  # no address of anything
        return False
    if has_token:
        hosts = {asked, headers.get("x-forwarded-host", "").lower()} - {""}
        return site is None or (site.scheme in ("http", "https") and place in hosts)
    if not asked:
        return site is None  # not a browser: those always say where they ask
    if site is not None and (site.scheme != "http" or place != asked):
        return False
    own = {"localhost", host.lower()}
    if host in ANYWHERE:
        own |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return name is not None and (name in own or is_address(name))


def is_address(host: str) -> bool:
    """Whether a host is given as an IP address."""
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


_HTML = {"Content-Type": "text/html; charset=utf-8", "Cache-Control": "no-store"}


def _page(text: str) -> str:
    return (
        '<!doctype html><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        "<title>unmix-nerf</title><style>:root{color-scheme:light dark}"
        "body{font:1.1em system-ui;max-width:30em;margin:20vh auto;padding:0 1em}input,button{font:inherit}</style>"
        f"<p>{html.escape(text)}</p>"
    )


_ASKING = (
    _page("This viewer asks for the token that it was started with.")
    + """<form><label>token <input type="password" autofocus autocomplete="current-password"></label>
<button>enter</button></form><p role="status"></p>
<script>
document.querySelector("form").onsubmit = async (event) => {
  event.preventDefault();
  const said = document.querySelector("[role=status]"), word = document.querySelector("input").value;
  const coded = btoa(String.fromCharCode(...new TextEncoder().encode(":" + word)));
  said.textContent = "checking";
  try {
    const answer = await fetch(location.pathname, {headers: {Authorization: "Basic " + coded}});
    if (answer.ok) location.reload(); else said.textContent = await answer.text();
  } catch (error) {
    said.textContent = "The viewer does not answer.";
  }
};
</script>"""
)
