"""How the viewer is served, as flags of commands; where it listens and how it is reached."""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.engine.training.training_control import SHARE_BOUNDS
from unmix_plugin.errors import ConfigError
from unmix_plugin.limits import read_bounded
from unmix_plugin.viewer.authentication import ANYWHERE, is_address

TOKEN_VARIABLE = "UNMIX_VIEWER_TOKEN"

_LONGEST_TOKEN = 4096
"""Bytes of a file that holds one."""


@dataclass(frozen=True)
class ViewerOptions:
    """How the viewer is served."""

    host: str = "127.0.0.1"
    """Address to listen at. Any but this machine's loopback lets others reach the viewer: give a token then."""
    port: int = 7007
    """Port to listen at; if it is taken the next free one is used, and said."""
    token: str | None = None
    """Word that the page asks for before it shows anything. Others on this machine can read words of a command: rather
    put it in the environment variable UNMIX_VIEWER_TOKEN, or give the file that holds it as @PATH."""
    environments: tuple[Path, ...] = ()
    """Environment maps (.exr, .hdr) to offer beside the built-in ones, for methods that know light and material
    apart."""

    def __post_init__(self) -> None:
        """Refuse impossible settings by `ConfigError`."""
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"--viewer.port is a number from 0 (any free one) to 65535; found {self.port}")
        if not self.host.strip():
            raise ConfigError("--viewer.host is empty; leave it out to listen on this machine only")
        if self.token is not None and not self.token.strip():
            raise ConfigError("--viewer.token is empty; leave it out or give a word that others can't guess")

    def secret(self, environment: Mapping[str, str]) -> str | None:
        """The token itself, from its file or a variable of the process; None without one, a ConfigError if where it is
        given holds none."""
        if self.token is None:
            word = environment.get(TOKEN_VARIABLE)
            if word is not None and not word.strip():
                raise ConfigError(
                    f"{TOKEN_VARIABLE} is empty; unset it or give a word that others can't guess"
                )
            return word and word.strip()
        if not self.token.startswith("@"):
            return self.token
        path = Path(self.token[1:])
        try:
            word = read_bounded(path, _LONGEST_TOKEN).decode().strip()
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or "it is no UTF-8 text"
            raise ConfigError(f"can't read the token of --viewer.token {self.token}: {reason}") from error
        if not word:
            raise ConfigError(f"{path} is empty; --viewer.token @PATH names a file that holds the token")
        return word


@dataclass(frozen=True)
class TrainingViewerOptions(ViewerOptions):
    """How a training is shown in the browser."""

    enabled: bool = False
    """Serve the viewer while training; on by default where the output is a terminal."""
    keep_open: bool = False
    """Serve on after training until Ctrl-C, rather than as long as a page is open."""
    share: float = 0.3
    """Part of the device's time that the viewer may take while someone moves the camera; at rest it takes about a
    quarter of that."""

    def __post_init__(self) -> None:
        """Refuse impossible settings by `ConfigError`."""
        super().__post_init__()
        low, high = SHARE_BOUNDS
        if not low <= self.share <= high:
            raise ConfigError(f"--viewer.share is a part from {low:g} to {high:g}; found {self.share}")


_PORTS_TRIED = 100


def free_port(host: str, port: int) -> int:
    """The port, or the next free one after it, for 0 any; a ConfigError if the host is not an address of this machine
    or no port near is free."""
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
        # Windows keeps whole ranges of ports for itself, and forbids them.
        if error.errno == errno.EADDRINUSE or (os.name == "nt" and error.errno == errno.EACCES):
            return None
        raise ConfigError(
            f"can't listen at --viewer.host {host}, port {port}: {error.strerror or error}; "
            "give an address of this machine, such as 127.0.0.1, and a port above 1023"
        ) from error


def start_notices(options: ViewerOptions, port: int, environment: Mapping[str, str]) -> list[str]:
    """What a user should read when the viewer starts to listen at a port: its URL first, then what they must know."""
    host = options.host
    shown = "localhost" if host in ANYWHERE else host
    lines = [f"viewer: http://[{shown}]:{port}" if ":" in shown else f"viewer: http://{shown}:{port}"]
    if options.port not in (0, port):
        lines.append(f"port {options.port} is taken, hence {port}")
    if host != "localhost" and not (is_address(host) and ipaddress.ip_address(host).is_loopback):
        reach = f"{socket.gethostname()}:{port}"
        protected = (
            "with the token; it travels unencrypted"
            if options.token is not None or TOKEN_VARIABLE in environment
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
