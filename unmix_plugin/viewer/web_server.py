"""viser's server as the viewer needs it: our title, no public tunnel, no uploads, connections that can be closed.

viser has no setting for these. All that this package uses of its private parts is here, as they are in viser 1.1.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import io
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import viser
from viser import infra
from viser._messages import FileTransferPart, FileTransferStartUpload

LABEL = "unmix-nerf"

_HEAD = f"""<title>{LABEL}</title>
<script>
  const asked = new URLSearchParams(location.search);
  if (matchMedia("(prefers-color-scheme: dark)").matches && !asked.has("darkMode")) {{
    asked.set("darkMode", "");
    history.replaceState(null, "", "?" + asked);
  }}
</script>"""

_MOST_CONNECTIONS = 64
"""Connections that may be open at once, served or not."""

_SENDING_S = 0.2
_READING_S = 2.0
"""How long a page that is turned away shows why before its connection is closed."""


class _PageServer(infra.WebsockServer):
    """Sends viser's page under our title, dark where the browser's user prefers that."""

    def __init__(self, *, http_server_root: Path, **options: Any) -> None:
        folder = Path(tempfile.mkdtemp(prefix="unmix-viewer-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        page = (http_server_root / "index.html").read_text()
        (folder / "index.html").write_text(page.replace("<title>Viser</title>", _HEAD, 1))
        super().__init__(http_server_root=folder, **options)


class _LocalServer(viser.ViserServer):
    """Never opens a public tunnel."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def open_server(host: str, port: int) -> viser.ViserServer:
    """A server that listens."""
    original = infra.WebsockServer
    infra.WebsockServer = _PageServer
    try:
        with quiet():
            server = _LocalServer(host=host, port=port, label=LABEL, verbose=False)
    finally:
        infra.WebsockServer = original
    websocket_server = server._websock_server
    _refuse_uploads(websocket_server)

    async def accept(connection: Any) -> None:
        _refuse_uploads(connection)
        if len(websocket_server._live_connections) > _MOST_CONNECTIONS:
            await websocket_server._live_connections[connection.client_id].close(1013)

    websocket_server.on_client_connect(accept)
    return server


def headers_of(client: viser.ClientHandle) -> dict[str, str] | None:
    """Headers of the request that opened a client's connection; None where they can't be read."""
    request = getattr(_connection_of(client), "request", None)
    return None if request is None else dict(request.headers.raw_items())


def address_of(client: viser.ClientHandle) -> str:
    """Where a client connects from; empty if unknown."""
    remote = getattr(_connection_of(client), "remote_address", None)
    return str(remote[0]) if remote else ""


def close_soon(client: viser.ClientHandle) -> None:
    """Close a client's connection, once it has shown what it was told."""
    connection = _connection_of(client)
    if connection is None:
        return

    async def close() -> None:
        await asyncio.sleep(_READING_S)
        await connection.close(1008)

    client.flush()
    asyncio.run_coroutine_threadsafe(close(), client._viser_server._event_loop)


def send_what_is_queued(server: viser.ViserServer) -> None:
    """Send pages what is queued for them, before a server is stopped."""
    server.flush()
    asyncio.run_coroutine_threadsafe(asyncio.sleep(_SENDING_S), server._event_loop).result()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Context without viser's own banner and farewell; ours name the real host and port."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def _connection_of(client: viser.ClientHandle) -> Any:
    """The websocket of a client; None if it has gone, or this viser keeps it elsewhere."""
    server = getattr(getattr(client, "_viser_server", None), "_websock_server", None)
    return getattr(server, "_live_connections", {}).get(client.client_id)


def _refuse_uploads(handler: Any) -> None:
    """No control takes files, and viser would keep what a page sends, whether or not the page is served."""
    for kind in (FileTransferStartUpload, FileTransferPart):
        if kind in handler._incoming_handlers:
            handler.unregister_handler(kind)
