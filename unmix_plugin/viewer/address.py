"""Where the viewer listens and how it is reached."""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
from collections.abc import Mapping

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.options import ViewerOptions

_PORTS_TRIED = 100
ANYWHERE = ("0.0.0.0", "::", "")
"""Hosts that mean every address of this machine."""


def free_port(host: str, port: int) -> int:
    """The port, or the next free one after it; for 0 any free one.

    Raises:
        ConfigError: the host is not an address of this machine, or no port near is free.
    """
    for candidate in range(port, min(port + _PORTS_TRIED, 65536)):
        found = _bound_port(host, candidate)
        if found is not None:
            return found
    raise ConfigError(
        f"no free port from {port} to {port + _PORTS_TRIED - 1} at {host}; choose another --viewer.port"
    )


def is_local(host: str) -> bool:
    """Whether only this machine can reach a host address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def url_of(host: str, port: int) -> str:
    """What to type into a browser, on this machine if the viewer listens everywhere.

    >>> url_of("127.0.0.1", 7007), url_of("::1", 7007)
    ('http://127.0.0.1:7007', 'http://[::1]:7007')
    """
    shown = "localhost" if host in ANYWHERE else host
    return f"http://[{shown}]:{port}" if ":" in shown else f"http://{shown}:{port}"


def notices(options: ViewerOptions, port: int, environment: Mapping[str, str] | None = None) -> list[str]:
    """What a user should read when the viewer starts: its URL first, then what they must know."""
    lines = [f"viewer: {url_of(options.host, port)}"]
    if options.port not in (0, port):
        lines.append(f"port {options.port} is taken, hence {port}")
    if not is_local(options.host):
        reach = f"{socket.gethostname()}:{port}"
        protected = (
            "with the token; it travels unencrypted"
            if options.token
            else "and change, render and save files in the run folder: give --viewer.token to ask for a word first"
        )
        lines.append(f"warning: everyone who reaches {reach} can use the viewer {protected}")
    elif "SSH_CONNECTION" in (os.environ if environment is None else environment):
        lines.append(
            f"from your own machine: {tunnel_command(port, environment)}, then open the address there"
        )
    return lines


def tunnel_command(port: int, environment: Mapping[str, str] | None = None) -> str:
    """The ssh command that makes the viewer of a remote machine reachable from where its user sits."""
    known = os.environ if environment is None else environment
    parts = known.get("SSH_CONNECTION", "").split()
    server = parts[2] if len(parts) == 4 else socket.gethostname()
    user = known.get("USER") or known.get("LOGNAME")
    port_flag = f" -p {parts[3]}" if len(parts) == 4 and parts[3] != "22" else ""
    return f"ssh -N -L {port}:127.0.0.1:{port}{port_flag} {f'{user}@' if user else ''}{server}"


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
