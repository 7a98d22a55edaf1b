"""The viewer's life cycle: listen, admit pages or ask them for the token, keep their sessions, shut down cleanly.

viser's server as the viewer needs it comes first: our title, no public tunnel, no uploads, connections that can be
closed. viser has no setting for these; all that this package uses of its private parts is here, as in viser 1.1.
"""

from __future__ import annotations

import asyncio
import atexit
import io
import os
import shutil
import signal
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import viser
from viser import infra
from viser._messages import FileTransferPart, FileTransferStartUpload

from unmix_plugin.editing import Recipe
from unmix_plugin.viewer.access import (
    MOST_CLIENTS,
    Gate,
    ViewerOptions,
    free_port,
    is_own_page,
    start_notices,
)
from unmix_plugin.viewer.page import failures_said, paragraph, text
from unmix_plugin.viewer.panels import panels_of
from unmix_plugin.viewer.rendering.scene import SceneSource
from unmix_plugin.viewer.session import KeptPages, SceneReader, Services, Session, browser_of
from unmix_plugin.viewer.view_cameras import point_ahead, pose_of, up_direction

_LABEL = "unmix-nerf"

_HEAD = f"""<title>{_LABEL}</title>
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


def _open_server(host: str, port: int) -> viser.ViserServer:
    """A server that listens."""
    original = infra.WebsockServer
    infra.WebsockServer = _PageServer
    try:
        with _quiet():
            server = _LocalServer(host=host, port=port, label=_LABEL, verbose=False)
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


def _headers_of(client: viser.ClientHandle) -> dict[str, str] | None:
    """Headers of the request that opened a client's connection; None where they can't be read."""
    request = getattr(_connection_of(client), "request", None)
    return None if request is None else dict(request.headers.raw_items())


def _address_of(client: viser.ClientHandle) -> str:
    """Where a client connects from; empty if unknown."""
    remote = getattr(_connection_of(client), "remote_address", None)
    return str(remote[0]) if remote else ""


def _close_soon(client: viser.ClientHandle) -> None:
    """Close a client's connection, once it has shown what it was told."""
    connection = _connection_of(client)
    if connection is None:
        return

    async def close() -> None:
        await asyncio.sleep(_READING_S)
        await connection.close(1008)

    client.flush()
    asyncio.run_coroutine_threadsafe(close(), client._viser_server._event_loop)


def _send_what_is_queued(server: viser.ViserServer) -> None:
    """Send pages what is queued for them, before a server is stopped."""
    server.flush()
    asyncio.run_coroutine_threadsafe(asyncio.sleep(_SENDING_S), server._event_loop).result()


@contextmanager
def _quiet() -> Iterator[None]:
    """Context without viser's own banner and farewell; ours name the real host and port."""
    with redirect_stdout(io.StringIO()):
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


_TICK_S = 0.5
_UNWATCHED_S = 5


class _TokenPrompt:
    """Asks one page for the token."""

    def __init__(self, client: viser.ClientHandle, gate: Gate) -> None:
        self.client = client
        self.note = client.gui.add_html(paragraph("This viewer asks for the token that it was started with."))
        self._word = client.gui.add_text("token", "")
        self._button = client.gui.add_button("enter")

        def enter(_: object) -> None:
            self.note.content = paragraph("checking")
            gate.guess(client.client_id, text(self._word.value))

        self._button.on_click(enter)

    def remove(self) -> None:
        """Make room for the panels."""
        for handle in (self.note, self._word, self._button):
            handle.remove()


class Viewer:
    """A run in the browser, from `start` to `stop`."""

    def __init__(
        self,
        source: SceneSource,
        options: ViewerOptions,
        read_scene: SceneReader,
        say: Callable[[str], None] = lambda _: None,
        recipe: Recipe | None = None,
    ) -> None:
        """
        Args:
            source: The model.
            options: Where to listen, and the token to ask for.
            read_scene: Reads the scene that the run was trained on.
            say: Prints a line on the user's terminal.
            recipe: Edits that every page starts with.
        Raises:
            ConfigError: the recipe does not fit the run, or environments were given and its method has none.
            SceneError: an environment map is missing, damaged or unusable.
        """
        self._options = options
        self._say = say
        self._gate = None if options.token is None else Gate(options.token)
        self._prompts: dict[int, _TokenPrompt] = {}
        self._sites_warned_of: set[str] = set()
        self._kept_pages = KeptPages()
        self.services = Services(source, read_scene, recipe, options.environments)
        self._sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._ticker = threading.Thread(target=self._tick, name="unmix-viewer-ticker", daemon=True)
        self._server: viser.ViserServer | None = None
        self.port = 0
        """Where it listens, once started."""

    def start(self) -> None:
        """Listen, and say where.

        Raises:
            ConfigError: the host is not an address of this machine, or no port near is free.
        """
        # A page that is closed while it is being sent something is not a reason to print anything.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        server = _open_server(self._options.host, free_port(self._options.host, self._options.port))
        self._server, self.port = server, server.get_port()
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.set_panel_label(_LABEL)
        scene = self.services.source.record
        up = up_direction(scene.train_cameras)
        server.scene.set_up_direction(up)
        server.scene.world_axes.visible = False
        camera = (scene.eval_cameras if len(scene.eval_cameras) else scene.train_cameras)[0]
        pose, first = pose_of(camera), server.initial_camera
        first.position, first.look_at = pose.position, point_ahead(camera, scene.scene_box)
        first.up, first.fov = up, pose.fov
        self.services.start()
        server.on_client_connect(self._connected)
        server.on_client_disconnect(self._disconnected)
        self._ticker.start()
        for line in start_notices(self._options, self.port, os.environ):
            self._say(line)

    def stop(self) -> None:
        """End all sessions, free the port and the threads; may be called twice."""
        if self._stopped.is_set():
            return
        self._stopped.set()
        with self._lock:
            sessions = list(self._sessions.values())
            self._sessions.clear()
        for session in sessions:
            session.tick()  # so that the page ends with the final state of the training
            session.close()
        if self._server is not None and sessions:
            _send_what_is_queued(self._server)
        self.services.stop()
        if self._server is not None:
            with _quiet():
                self._server.stop()
        if self._ticker.is_alive():
            self._ticker.join()

    @property
    def num_clients(self) -> int:
        """Pages that are served."""
        return len(self._sessions)

    def wait(self, while_watched: bool = False) -> None:
        """Serve until Ctrl-C, SIGTERM or SIGHUP, which raise KeyboardInterrupt, or until stopped by another thread.

        Args:
            while_watched: End once no page has been open for some seconds, too; a page that is loaded again is back by
                then.
        """
        unwatched_s = 0
        with _interrupting_signals():
            while not self._stopped.wait(1.0):
                unwatched_s = 0 if self._sessions else unwatched_s + 1
                if while_watched and unwatched_s >= _UNWATCHED_S:
                    return

    def _connected(self, client: viser.ClientHandle) -> None:
        """Admit a page, ask it for the token, or refuse it."""
        with failures_said("this page could not be served", lambda said: _warn(client, said)):
            reason, gate = self._refusal(client), self._gate
            if not reason and gate is None:
                self._open(client)
            elif not reason and gate is not None:
                if gate.enter(client.client_id, _address_of(client)):
                    with client.atomic():  # nobody can answer before the answer is listened for
                        self._prompts[client.client_id] = _TokenPrompt(client, gate)
                else:
                    reason = (
                        "too many pages are asked for the token already: close one and load this page again"
                    )
            if reason:
                _warn(client, reason)
                _close_soon(client)

    def _refusal(self, client: viser.ClientHandle) -> str:
        """Why a page is not served; empty if it is."""
        if len(self._sessions) >= MOST_CLIENTS:
            return f"{MOST_CLIENTS} pages are open already: close one and load this page again"
        headers = _headers_of(client)
        if self._gate is not None or is_own_page(headers, self._options.host):
            return ""
        site = (headers or {}).get("Origin", "unknown")[:100]
        if site not in self._sites_warned_of and len(self._sites_warned_of) < MOST_CLIENTS:
            self._sites_warned_of.add(site)
            self._say(
                f"warning: a page of another site ({site}) tried to use the viewer and was refused; if it is yours, "
                "start the viewer with --viewer.token"
            )
        return "this page is from another site; the viewer must be started with --viewer.token to serve it"

    def _open(self, client: viser.ClientHandle) -> None:
        browser = browser_of(client)
        session = Session(client, self.services, self._kept_pages.take(browser), browser)
        with self._lock:
            if self._stopped.is_set() or client.client_id in self._sessions:
                return
            self._sessions[client.client_id] = session
        session.open(panels_of(self.services))
        if self._server is not None and client.client_id not in self._server.get_clients():
            self._disconnected(client)  # it left before it was noted

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self._forget_prompt(client)
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
            self._kept_pages.leave(session.browser, session.state)

    def _forget_prompt(self, client: viser.ClientHandle) -> None:
        self._prompts.pop(client.client_id, None)
        if self._gate is not None:
            self._gate.leave(client.client_id)

    def _tick(self) -> None:
        """Let panels follow a run that goes on, and check tokens."""
        while not self._stopped.wait(_TICK_S):
            with failures_said("panels could not be renewed", self._say):
                self._check_tokens()
                self.services.tick()
                for session in list(self._sessions.values()):
                    session.tick()

    def _check_tokens(self) -> None:
        for page, is_right in ({} if self._gate is None else self._gate.verdicts()).items():
            prompt = self._prompts.get(page)
            if prompt is not None and is_right:
                self._forget_prompt(prompt.client)
                prompt.remove()
                self._open(prompt.client)
            elif prompt is not None:
                prompt.note.content = paragraph("That is not the token.", is_warning=True)


@contextmanager
def _interrupting_signals() -> Iterator[None]:
    """Context in which SIGTERM and SIGHUP act like Ctrl-C; signals that are ignored, as under nohup, stay ignored."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _warn(client: viser.ClientHandle, reason: str) -> None:
    client.gui.add_html(paragraph(reason, is_warning=True))
