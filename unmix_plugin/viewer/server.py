"""The life of a viewer: listening, letting clients in, keeping their sessions, and ending without leftovers."""

from __future__ import annotations

import contextlib
import io
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from unmix_plugin.editing import Recipe
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.viewer import html
from unmix_plugin.viewer.address import free_port, notices
from unmix_plugin.viewer.failures import failures_said
from unmix_plugin.viewer.gate import MOST_CLIENTS, Gate, is_of_another_site
from unmix_plugin.viewer.inputs import text
from unmix_plugin.viewer.options import ViewerOptions
from unmix_plugin.viewer.panels import PANELS
from unmix_plugin.viewer.rendering.model_source import ModelSource
from unmix_plugin.viewer.services import SceneReader, Services
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import pose_of, up_direction

if TYPE_CHECKING:
    import viser

_TICK_S = 0.5
_LABEL = "unmix-nerf"


class Viewer:
    """A run in the browser, from `start` to `stop`."""

    def __init__(
        self,
        source: ModelSource,
        options: ViewerOptions,
        read_scene: SceneReader,
        say: Callable[[str], None] = lambda _: None,
        recipe: Recipe | None = None,
    ) -> None:
        """
        Args:
            source: The model.
            options: Where to listen, and the word to ask for.
            read_scene: Reads the scene that the run was trained on.
            say: Takes lines for the user's terminal.
            recipe: Edits that every page starts with.
        Raises:
            ConfigError: the recipe does not fit the run.
        """
        self._options = options
        self._say = say
        self._gate = Gate(options.token)
        self._services = Services(source, read_scene, recipe)
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
            ConfigError: the host is no address of this machine, or no port near is free.
        """
        # A page that is closed while it is being sent something is no reason to print anything.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        port = free_port(self._options.host, self._options.port)
        with _quiet():
            self._server = _server_at(self._options.host, port)
        self.port = self._server.get_port()
        self._dress(self._server)
        self._services.start()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        self._ticker.start()
        for line in notices(self._options, self.port):
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
            session.close()
        self._services.stop()
        if self._server is not None:
            with _quiet():
                self._server.stop()
        if self._ticker.is_alive():
            self._ticker.join()

    @property
    def num_clients(self) -> int:
        """Pages that are served."""
        return len(self._sessions)

    @property
    def services(self) -> Services:
        """What all sessions share."""
        return self._services

    def wait(self) -> None:
        """Serve until Ctrl-C, or until stopped by another thread."""
        while not self._stopped.wait(1.0):
            pass

    def _dress(self, server: viser.ViserServer) -> None:
        """Looks, and where pages start to look from."""
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.set_panel_label(_LABEL)
        scene = self._services.source.scene
        up = up_direction(scene.train_cameras)
        server.scene.set_up_direction(up)
        server.scene.world_axes.visible = False
        self._place_camera(server, scene.eval_cameras if len(scene.eval_cameras) else scene.train_cameras, up)

    def _place_camera(
        self, server: viser.ViserServer, cameras: Cameras, up: tuple[float, float, float]
    ) -> None:
        camera = cameras[0]
        pose = pose_of(camera)
        middle = self._services.source.scene.scene_box.aabb.mean(dim=0)
        place, forward = camera.camera_to_world[0, :, 3], -camera.camera_to_world[0, :, 2]
        reach = max(float((middle - place) @ forward), 0.1)
        x, y, z = (place + reach * forward).tolist()
        start = server.initial_camera
        start.position, start.look_at, start.up, start.fov = pose.position, (x, y, z), up, pose.fov

    def _connected(self, client: viser.ClientHandle) -> None:
        """Let a page in, or ask it for the word."""
        with failures_said("this page could not be served", lambda text: _warn(client, text)):
            reason = self._refusal(client)
            if reason:
                _warn(client, reason)
            elif self._gate.is_open:
                self._open(client)
            else:
                self._ask(client)

    def _refusal(self, client: viser.ClientHandle) -> str:
        """Why a page is not served; empty if it is."""
        if self.num_clients >= MOST_CLIENTS:
            return f"{MOST_CLIENTS} pages are open already: close one and load this page again"
        if self._gate.is_open and is_of_another_site(_headers_of(client)):
            self._say(
                "warning: a page of another site tried to use the viewer and was refused; if it is yours, use a token"
            )
            return (
                "this page is from another site; the viewer must be started with --viewer.token to serve it"
            )
        return ""

    def _ask(self, client: viser.ClientHandle) -> None:
        gui = client.gui
        note = gui.add_html(html.paragraph("This viewer asks for the token that it was started with."))
        word = gui.add_text("token", "")
        button = gui.add_button("enter")

        def enter(_: Any) -> None:
            if not self._gate.admits(text(word.value)):
                note.content = html.paragraph(
                    "That is not the token; wait a moment and try again.", is_warning=True
                )
                return
            for handle in (note, word, button):
                handle.remove()
            self._open(client)

        button.on_click(enter)

    def _open(self, client: viser.ClientHandle) -> None:
        session = Session(client, self._services)
        with self._lock:
            if self._stopped.is_set() or client.client_id in self._sessions:
                return
            self._sessions[client.client_id] = session
        session.open(PANELS)
        if self._server is not None and client.client_id not in self._server.get_clients():
            self._disconnected(client)  # it left before it was noted

    def _disconnected(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _tick(self) -> None:
        """Let panels follow a run that goes on."""
        while not self._stopped.wait(_TICK_S):
            with failures_said("panels could not be renewed", self._say):
                self._services.tick()
                for session in list(self._sessions.values()):
                    session.tick()


def _warn(client: viser.ClientHandle, reason: str) -> None:
    client.gui.add_html(html.paragraph(reason, is_warning=True))


def _server_at(host: str, port: int) -> viser.ViserServer:
    """viser's server without its public tunnel, which any page could else ask for."""
    import viser

    class LocalServer(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    return LocalServer(host=host, port=port, label=_LABEL, verbose=False)


def _headers_of(client: viser.ClientHandle) -> Mapping[str, str]:
    """Headers of the request that opened a client's connection; none where this viser does not give them."""
    server = getattr(getattr(client, "_viser_server", None), "_websock_server", None)
    connection = getattr(server, "_live_connections", {}).get(client.client_id)
    request = getattr(connection, "request", None)
    return {} if request is None else dict(request.headers.raw_items())


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """viser prints a banner and a farewell of its own; ours say what is true of host and port."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
