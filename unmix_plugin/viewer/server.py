"""What a page shows before it has given the token.

The viewer's life cycle: listen, admit clients, keep their sessions, shut down cleanly.
"""

from __future__ import annotations

import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from unmix_plugin.editing import Recipe
from unmix_plugin.viewer import page as html
from unmix_plugin.viewer.access import (
    MOST_CLIENTS,
    Gate,
    ViewerOptions,
    free_port,
    is_own_page,
    start_notices,
)
from unmix_plugin.viewer.page import failures_said, text
from unmix_plugin.viewer.panels import PANELS
from unmix_plugin.viewer.rendering.scene import SceneSource
from unmix_plugin.viewer.session import KeptPages, SceneReader, Services, Session, browser_of
from unmix_plugin.viewer.view_cameras import point_ahead, pose_of, up_direction
from unmix_plugin.viewer.web_server import (
    LABEL,
    address_of,
    close_soon,
    headers_of,
    open_server,
    quiet,
    send_what_is_queued,
)

if TYPE_CHECKING:
    import viser


class TokenPrompt:
    """Asks one page for the token."""

    def __init__(self, client: viser.ClientHandle, gate: Gate) -> None:
        self.client = client
        gui = client.gui
        self._note = gui.add_html(html.paragraph("This viewer asks for the token that it was started with."))
        self._word = gui.add_text("token", "")
        self._button = gui.add_button("enter")

        def enter(_: Any) -> None:
            self._note.content = html.paragraph("checking")
            gate.guess(client.client_id, text(self._word.value))

        self._button.on_click(enter)

    def refuse(self) -> None:
        """Say that the guess was wrong."""
        self._note.content = html.paragraph("That is not the token.", is_warning=True)

    def remove(self) -> None:
        """Make room for the panels."""
        for handle in (self._note, self._word, self._button):
            handle.remove()


class _TokenPrompts:
    """Pages that have yet to give the token."""

    def __init__(self, gate: Gate, admit: Callable[[viser.ClientHandle], None]) -> None:
        """
        Args:
            gate: Checks what they give.
            admit: Serves a page that gave the token.
        """
        self._gate, self._admit = gate, admit
        self._prompts: dict[int, TokenPrompt] = {}
        self._lock = threading.Lock()

    def ask(self, client: viser.ClientHandle, address: str) -> bool:
        """Ask a page; False if too many from its address are asked already."""
        if not self._gate.enter(client.client_id, address):
            return False
        with client.atomic():  # nobody can answer before the answer is listened for
            prompt = TokenPrompt(client, self._gate)
            with self._lock:
                self._prompts[client.client_id] = prompt
        return True

    def leave(self, client: viser.ClientHandle) -> None:
        """Forget a page."""
        self._gate.leave(client.client_id)
        with self._lock:
            self._prompts.pop(client.client_id, None)

    def tick(self) -> None:
        """Check a guess from each address; called at a steady pace."""
        for page, is_right in self._gate.verdicts().items():
            with self._lock:
                prompt = self._prompts.get(page)
            if prompt is None:
                continue
            if not is_right:
                prompt.refuse()
                continue
            self.leave(prompt.client)
            prompt.remove()
            self._admit(prompt.client)


_TICK_S = 0.5
_UNWATCHED_S = 5


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
        self._gate = Gate(options.token)
        self._prompts = _TokenPrompts(self._gate, self._open)
        self._sites_warned_of: set[str] = set()
        self._kept_pages = KeptPages()
        self._services = Services(source, read_scene, recipe, options.environments)
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
        port = free_port(self._options.host, self._options.port)
        self._server = open_server(self._options.host, port)
        self.port = self._server.get_port()
        self._dress(self._server)
        self._services.start()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        self._ticker.start()
        for line in start_notices(self._options, self.port):
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
            send_what_is_queued(self._server)
        self._services.stop()
        if self._server is not None:
            with quiet():
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

    def _dress(self, server: viser.ViserServer) -> None:
        """Set the theme, and where pages start to look from."""
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.set_panel_label(LABEL)
        scene = self._services.source.record
        up = up_direction(scene.train_cameras)
        server.scene.set_up_direction(up)
        server.scene.world_axes.visible = False
        camera = (scene.eval_cameras if len(scene.eval_cameras) else scene.train_cameras)[0]
        pose, start = pose_of(camera), server.initial_camera
        start.position, start.look_at = pose.position, point_ahead(camera, scene.scene_box)
        start.up, start.fov = up, pose.fov

    def _connected(self, client: viser.ClientHandle) -> None:
        """Admit a page, ask it for the token, or refuse it."""
        with failures_said("this page could not be served", lambda text: _warn(client, text)):
            reason = self._refusal(client)
            if not reason and self._gate.is_open:
                self._open(client)
            elif not reason and not self._prompts.ask(client, address_of(client)):
                reason = "too many pages are asked for the token already: close one and load this page again"
            if reason:
                _warn(client, reason)
                close_soon(client)

    def _refusal(self, client: viser.ClientHandle) -> str:
        """Why a page is not served; empty if it is."""
        if self.num_clients >= MOST_CLIENTS:
            return f"{MOST_CLIENTS} pages are open already: close one and load this page again"
        headers = headers_of(client)
        if not self._gate.is_open or is_own_page(headers, self._options.host):
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
        session = Session(client, self._services, self._kept_pages.take(browser), browser)
        with self._lock:
            if self._stopped.is_set() or client.client_id in self._sessions:
                return
            self._sessions[client.client_id] = session
        session.open(PANELS)
        if self._server is not None and client.client_id not in self._server.get_clients():
            self._disconnected(client)  # it left before it was noted

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self._prompts.leave(client)
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
            self._kept_pages.leave(session.browser, session.state)

    def _tick(self) -> None:
        """Let panels follow a run that goes on, and check tokens."""
        while not self._stopped.wait(_TICK_S):
            with failures_said("panels could not be renewed", self._say):
                self._prompts.tick()
                self._services.tick()
                for session in list(self._sessions.values()):
                    session.tick()


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
    client.gui.add_html(html.paragraph(reason, is_warning=True))
