"""How the viewer is served, as flags of commands; where it listens and how it is reached; who may use it."""

from __future__ import annotations

import errno
import hmac
import ipaddress
import os
import socket
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from unmix_plugin.engine.training.training_control import SHARE_BOUNDS
from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class ViewerOptions:
    """How the viewer is served; impossible settings are a `ConfigError`."""

    host: str = "127.0.0.1"
    """Address to listen at. Any but this machine's loopback lets others reach the viewer: give a token then."""
    port: int = 7007
    """Port to listen at; if it is taken the next free one is used, and said."""
    token: str | None = None
    """Word that the page asks for before it shows anything."""
    environments: tuple[Path, ...] = ()
    """Environment maps (.exr, .hdr) to offer beside the built-in ones, for methods that know light and material
    apart."""

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"--viewer.port is a number from 0 (any free one) to 65535; found {self.port}")
        if not self.host.strip():
            raise ConfigError("--viewer.host is empty; leave it out to listen on this machine only")
        if self.token is not None and not self.token.strip():
            raise ConfigError("--viewer.token is empty; leave it out or give a word that others can't guess")


@dataclass(frozen=True)
class TrainingViewerOptions(ViewerOptions):
    """How a training is shown in the browser; impossible settings are a `ConfigError`."""

    enabled: bool = False
    """Serve the viewer while training; on by default where the output is a terminal."""
    keep_open: bool = False
    """Serve on after training until Ctrl-C, rather than as long as a page is open."""
    share: float = 0.3
    """Part of the device's time that the viewer may take while someone moves the camera; at rest it takes about a
    quarter of that."""

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = SHARE_BOUNDS
        if not low <= self.share <= high:
            raise ConfigError(f"--viewer.share is a part from {low:g} to {high:g}; found {self.share}")


_PORTS_TRIED = 100
_ANYWHERE = ("0.0.0.0", "::", "")
"""Hosts that mean every address of this machine."""


def free_port(host: str, port: int) -> int:
    """The port, or the next free one after it; for 0 any free one.

    Raises:
        ConfigError: the host is not an address of this machine, or no port near is free.
    """
    for candidate in range(port, min(port + _PORTS_TRIED, 65536)):
        if (found := _bound_port(host, candidate)) is not None:
            return found
    raise ConfigError(
        f"no free port from {port} to {port + _PORTS_TRIED - 1} at {host}; choose another --viewer.port"
    )


def _bound_port(host: str, port: int) -> int | None:
    """Bind and let go; the port that it was, None if it is taken."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            if os.name == "posix":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
            return int(probe.getsockname()[1])
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            return None
        raise ConfigError(
            f"can't listen at --viewer.host {host}, port {port}: {error.strerror or error}; "
            "give an address of this machine, such as 127.0.0.1, and a port above 1023"
        ) from error


def start_notices(options: ViewerOptions, port: int, environment: Mapping[str, str]) -> list[str]:
    """What a user should read when the viewer starts: its URL first, then what they must know.

    Args:
        options: As given.
        port: Where it listens.
        environment: Variables of the process.
    """
    host = options.host
    shown = "localhost" if host in _ANYWHERE else host
    lines = [f"viewer: http://[{shown}]:{port}" if ":" in shown else f"viewer: http://{shown}:{port}"]
    if options.port not in (0, port):
        lines.append(f"port {options.port} is taken, hence {port}")
    if host != "localhost" and not (_is_address(host) and ipaddress.ip_address(host).is_loopback):
        reach = f"{socket.gethostname()}:{port}"
        protected = (
            "with the token; it travels unencrypted"
            if options.token
            else "and change, render and save files in the run folder: give --viewer.token to ask for a word first"
        )
        lines.append(f"warning: everyone who reaches {reach} can use the viewer {protected}")
    elif "SSH_CONNECTION" in environment:
        parts = environment["SSH_CONNECTION"].split()
        is_known = len(parts) == 4
        server = parts[2] if is_known else socket.gethostname()
        user = environment.get("USER") or environment.get("LOGNAME")
        command = f"ssh -N -L {port}:127.0.0.1:{port}"
        command += f" -p {parts[3]}" if is_known and parts[3] != "22" else ""
        command += f" {user}@{server}" if user else f" {server}"
        lines.append(f"from your own machine: {command}, then open the address there")
    return lines


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


MOST_CLIENTS = 16
"""Pages that are served at once."""

MOST_WAITING = 16
"""Pages from one address that may be asked for the token at once."""


class Gate:
    """Checks tokens, one at a time for each address, so that nobody gets through a dictionary.

    A page's guess waits for its turn; the right token is never turned down because others guessed wrong.
    """

    def __init__(self, token: str) -> None:
        self._token = token
        self._lock = threading.Lock()
        self._address_of: dict[int, str] = {}
        self._guesses: dict[int, str] = {}

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
            token = self._token.encode()
            return {
                page: hmac.compare_digest(self._guesses.pop(page).encode(), token) for page in chosen.values()
            }


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
    name = urlsplit(f"//{asked}").hostname
    if name is None or urlsplit(known["origin"]).netloc != asked:
        return False
    own = {"localhost", host.lower()}
    if host in _ANYWHERE:
        own |= {socket.gethostname().lower(), socket.getfqdn().lower()}
    return name in own or _is_address(name)
