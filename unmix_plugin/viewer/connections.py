"""viser behind authentication and limits: every request is judged, every message bounded, before viser sees it.

viser has no setting for that, but asks `websockets.asyncio.server.serve`, a public function, for its server. While it
starts, that name stands for ours, which adds what websockets offers for the purpose: a judge of requests, headers of
answers, a class of connections. Of viser nothing private is used. A version that came by its server in another way is
stopped at once, and refused. Behind a proxy viser would have a port of its own, at which others on this machine could
reach it past the token and the limits.
"""

from __future__ import annotations

import asyncio
import gzip
import io
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import lru_cache, partial
from html import escape
from http import HTTPStatus
from typing import Any, TypeAlias

import msgspec
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.authentication import Authentication, WarningsOfStrangers

LABEL = "unmix-nerf"

_HEAD = """<title>TITLE</title>
<style>
  /* Eight tabs fit side by side. */
  [role="tablist"] { flex-wrap: nowrap !important; overflow-x: auto; scrollbar-width: none }
  [role="tab"] { padding: 0.6em 0.2em !important; font-size: 0.9em !important; flex: 1 0 auto }
  .uplot:not(:hover) .u-legend .u-value, .uplot:not(:hover) .u-legend .u-label::after { visibility: hidden }
  /* viser's sheet of controls on phones: as wide as the screen, and its head, which folds it, says so. */
  @media (max-width: 36em) {
    [style*="min-height: 3.5em"], [style*="min-height: 3.5em"] [style*="width: 20em"] { width: 100% !important }
    [style*="cursor: pointer"][style*="height: 3.5em"]::after { content: "\\2630  controls"; padding-left: 1em }
  }
</style>
<script>
  const asked = new URLSearchParams(location.search);
  if (matchMedia("(prefers-color-scheme: dark)").matches && !asked.has("darkMode")) {
    asked.set("darkMode", "");
    history.replaceState(null, "", "?" + asked);
  }
  if (matchMedia("(max-width: 36em)").matches) new MutationObserver((_, watch) => {
    const head = document.querySelector('[style*="cursor: pointer"][style*="height: 3.5em"]');
    if (head) { watch.disconnect(); head.click(); }
  }).observe(document, {childList: true, subtree: true});
</script>"""
"""The title, and what viser's page lacks: tabs in one row, charts without dashes for values, a picture first on
phones."""

_LARGEST_MESSAGE = 1 << 16
"""Bytes. The longest that a page says is the text of a box."""

_MOST_FRAGMENTS = 64
"""Of one message; browsers send one."""

_SILENT_S = 60.0
"""How long a page may say nothing at first: its browser loads the parts that it draws with."""

_SENDING_S = 0.2
_LONGEST_FAULT = 200


class _Camera(msgspec.Struct, tag="ViewerCameraMessage", tag_field="type"):
    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov: float
    near: float
    far: float
    image_height: float
    image_width: float
    look_at: tuple[float, float, float]
    up_direction: tuple[float, float, float]


class _Update(msgspec.Struct, tag="GuiUpdateMessage", tag_field="type"):
    uuid: str
    updates: dict[str, Any]


class _Stored(msgspec.Struct, tag="LocalStorageGetItemResponseMessage", tag_field="type"):
    value: str | None
    error: str | None
    request_uuid: str


class _Pointer(msgspec.Struct, tag="ScenePointerMessage", tag_field="type"):
    event_type: str
    ray_origin: tuple[float, float, float] | None
    ray_direction: tuple[float, float, float] | None
    screen_pos: tuple[tuple[float, float], ...]
    modifier: str | None


_Known: TypeAlias = _Camera | _Update | _Stored | _Pointer
_DECODER = msgspec.msgpack.Decoder(_Known)


class _Any(msgspec.Struct):
    type: str


_ANY_DECODER = msgspec.msgpack.Decoder(_Any)
_KINDS = {kind.__struct_config__.tag for kind in (_Camera, _Update, _Stored, _Pointer)}


def is_heard(data: bytes) -> bool:
    """Whether a message is one that the viewer listens to; others, such as uploads and requests for a tunnel, are not.
    A ValueError if it is no message of a page."""
    try:
        if _ANY_DECODER.decode(data).type not in _KINDS:
            return False
        message = _DECODER.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(str(error)) from error
    return not isinstance(message, _Update) or set(message.updates) == {"value"}


@dataclass
class RateLimit:
    """How fast a page may send; browsers send cameras and sliders some tens of times a second."""

    messages_per_s: float = 200.0
    bytes_per_s: float = 2.0**19
    burst_s: float = 2.0
    """How much of that may come at once."""
    _paid_until: float = 0.0

    def delay(self, size: int, now: float) -> float:
        """Seconds to wait after a message of so many bytes that came now, before the next is taken."""
        cost = max(1 / self.messages_per_s, size / self.bytes_per_s)
        self._paid_until = max(self._paid_until, now - self.burst_s) + cost
        return max(self._paid_until - now, 0.0)


class _Connection(ServerConnection):
    """A page's connection: what comes is bounded in size and pace before anything of it is kept."""

    def __init__(self, authentication: Authentication, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._authentication = authentication
        self._rate, self._has_spoken = RateLimit(), False

    async def recv(self, decode: bool | None = None) -> Any:
        """The next message that the viewer listens to; a page that sends what none sends loses its connection."""
        while True:
            data = await self._next_message()
            # While it waits a page that sends too fast can't send either.
            if delay := self._rate.delay(len(data), time.monotonic()):
                await asyncio.sleep(delay)
            try:
                if is_heard(data):
                    return data
            except ValueError:
                await self.close(1007, "not a message of a page")

    async def _next_message(self) -> bytes:
        try:
            # Cut short it could not go on with the next message; there is none after the first is missing.
            data = await asyncio.wait_for(self._joined(), None if self._has_spoken else _SILENT_S)
        except asyncio.TimeoutError:
            data = None
        self._has_spoken = True
        if data is not None:
            return data
        await self.close(1008, "too many parts, or silent for too long")
        return await super().recv(decode=False)  # raises, since it is closed

    async def _joined(self) -> bytes | None:
        """A message from its parts; None if it has too many."""
        parts: list[bytes] = []
        async for part in self.recv_streaming(decode=False):
            parts.append(part)
            if len(parts) > _MOST_FRAGMENTS:
                return None
        return b"".join(parts)

    def connection_lost(self, exc: Exception | None) -> None:
        """Give back the page's place."""
        super().connection_lost(exc)
        self._authentication.leave(self)


class _LocalServer(viser.ViserServer):
    """Never opens a public tunnel."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


_HEADERS = {"Content-Security-Policy": "frame-ancestors 'self'", "X-Frame-Options": "SAMEORIGIN"}
"""Of every answer: no page of another site can show the viewer in a frame, and have its user click unseen."""

_STARTING = threading.Lock()
"""Held while `websockets.asyncio.server.serve` stands for ours."""


def open_server(
    host: str, port: int, authentication: Authentication, say: Callable[[str], None], title: str = LABEL
) -> viser.ViserServer:
    """A server that listens, and lets in what the authentication does; `title` is that of its pages, and `say` is told
    of what pages caused that should not have happened, in a short line each. A ConfigError if viser is of a version
    that can't be guarded."""
    serve, ports = websockets.asyncio.server.serve, iter(range(port, 65536))
    logger = logging.Logger(LABEL)  # of nobody: requests of strangers are not for the user's log
    logger.addHandler(logging.NullHandler())

    def serve_guarded(handler: Any, *_address: Any, process_request: Any, **options: Any) -> Any:
        warnings = WarningsOfStrangers(say)  # a traceback of each fault would fill the disk

        def warn(_loop: Any, context: dict[str, Any]) -> None:
            error = context.get("exception")
            kind = type(error).__name__ if error else str(context.get("message", ""))[:_LONGEST_FAULT]
            text = "" if error is None else str(error)[:_LONGEST_FAULT]
            warnings.warn(kind, f"the viewer could not take something that a page sent ({kind}: {text!r})")

        asyncio.get_running_loop().set_exception_handler(warn)
        guards = {
            "process_request": partial(_answer, authentication, process_request, title),
            "process_response": lambda _connection, _request, response: _with_headers(response, _HEADERS),
            "create_connection": partial(_Connection, authentication),
            "max_size": _LARGEST_MESSAGE,
            "max_queue": 4,
            "logger": logger,
        }
        # Asked once more, viser found its port taken meanwhile.
        return serve(handler, host, next(ports), **{**options, **guards})

    with _STARTING, quiet():
        websockets.asyncio.server.serve = serve_guarded  # type: ignore[misc, assignment]
        try:
            server = _LocalServer(host="127.0.0.1", port=0, label=LABEL, verbose=False)
        finally:
            websockets.asyncio.server.serve = serve  # type: ignore[misc]
        if next(ports, 65536) == port:
            server.stop()
            raise ConfigError(
                f"viser {viser.__version__} starts its server in a way that the viewer can't guard; install viser 1.1"
            )
    return server


async def _answer(
    authentication: Authentication,
    read_file: Callable[[ServerConnection, Request], Response],
    title: str,
    connection: ServerConnection,
    request: Request,
) -> Response | None:
    """The answer to a request: a refusal, or the page; None opens the connection that was asked for. `read_file` is
    viser's own answer to requests for files."""
    headers = {name.lower(): value for name, value in request.headers.raw_items()}
    opens = headers.get("upgrade", "").lower() == "websocket"
    versions = [word.strip() for word in headers.get("sec-websocket-protocol", "").split(",")]
    if opens and f"viser-v{viser.__version__}" not in versions:
        return connection.respond(HTTPStatus.BAD_REQUEST, "this page is of another version: load it again")
    remote, local = connection.remote_address or ("",), connection.local_address or ("", 0)
    refusal = await authentication.refusal(connection, headers, address=remote[0], port=local[1])
    if refusal is not None:
        return _with_headers(connection.respond(refusal.status, refusal.text), refusal.headers)
    if opens:
        return None
    if request.path.partition("?")[0] not in ("/", "/index.html"):
        return read_file(connection, request)
    request.headers.pop("Accept-Encoding", None)  # so that viser's page comes as it is
    response = read_file(connection, request)
    plain, packed = _page_under(title, bytes(response.body))
    is_packed = "gzip" in headers.get("accept-encoding", "")
    response.body = packed if is_packed else plain
    encoding = {"Content-Encoding": "gzip"} if is_packed else {}
    response.headers.pop("Content-Encoding", None)
    return _with_headers(response, {**encoding, "Content-Length": str(len(response.body))})


@lru_cache(maxsize=8)
def _page_under(title: str, page: bytes) -> tuple[bytes, bytes]:
    """viser's page with our head, as it is and compressed."""
    head = _HEAD.replace("TITLE", escape(title)).encode()
    plain = page.replace(b"<title>Viser</title>", head, 1)
    return plain, gzip.compress(plain)


def _with_headers(response: Response, headers: Mapping[str, str]) -> Response:
    """The response with headers in place of those of the same names."""
    for name, value in headers.items():
        response.headers.pop(name, None)
        response.headers[name] = value
    return response


def send_what_is_queued(server: viser.ViserServer) -> None:
    """Send pages what is queued for them, before a server is stopped."""
    server.flush()
    time.sleep(_SENDING_S)


@contextmanager
def quiet() -> Iterator[None]:
    """Context without viser's own banner and farewell; ours name the real host and port."""
    with redirect_stdout(io.StringIO()):
        yield
