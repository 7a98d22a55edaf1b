"""The viewer's life cycle: listen, keep a session for each page that is let in, shut down cleanly."""

from __future__ import annotations

import os
import secrets
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import viser

from unmix_plugin.trained.run_views import up_direction
from unmix_plugin.viewer.access import ViewerOptions, free_port, start_notices
from unmix_plugin.viewer.authentication import Authentication
from unmix_plugin.viewer.connections import LABEL, open_server, quiet, send_what_is_queued
from unmix_plugin.viewer.page import paragraph, reporting_failures
from unmix_plugin.viewer.panels import panels_of
from unmix_plugin.viewer.session import PageState, Services, Session
from unmix_plugin.viewer.view_cameras import beside, point_ahead, pose_of

_TICK_S = 0.5
_UNWATCHED_S = 5

_KEPT_S = 600.0
"""How long what a page left is kept."""

_MOST_KEPT = 64
_STORAGE_KEY = "unmix-nerf"
_ANSWER_S = 2.0


class KeptPages:
    """States of pages that were closed recently, by the browser that they were in."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left: list[tuple[float, str, PageState]] = []
        self._lock = threading.Lock()

    def leave(self, browser: str, state: PageState) -> None:
        """Keep the state of a page that was closed."""
        with self._lock:
            self._left = [*self._left, (self._clock(), browser, state)][-_MOST_KEPT:]

    def take(self, browser: str) -> PageState | None:
        """The state of the browser's page that was closed last and has not come back; None if there is none."""
        with self._lock:
            self._left = [kept for kept in self._left if self._clock() - kept[0] < _KEPT_S]
            mine = [index for index, kept in enumerate(self._left) if kept[1] == browser]
            return self._left.pop(mine[-1])[2] if mine else None


def _browser_of(client: viser.ClientHandle) -> str:
    """The name that a page's browser keeps for this viewer, a new one if it has none or does not say."""
    try:
        known = client.local_storage.get_item(_STORAGE_KEY, _ANSWER_S)
    except (RuntimeError, TimeoutError):  # storage is blocked, or the page has gone
        known = None
    if isinstance(known, str) and 0 < len(known) < 100:
        return known
    name = secrets.token_hex(16)
    client.local_storage.set_item(_STORAGE_KEY, name)
    return name


class Viewer:
    """A run in the browser, from `start` to `stop`."""

    def __init__(
        self, services: Services, options: ViewerOptions, say: Callable[[str], None] = lambda _: None
    ) -> None:
        """`say` prints a line on the user's terminal; a ConfigError if the token can't be read."""
        self._options, self._say = options, say
        self._authentication = Authentication(options.host, options.secret(os.environ), say)
        self._kept_pages = KeptPages()
        self.services = services
        self._sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._ticker = threading.Thread(target=self._tick, name="unmix-viewer-ticker", daemon=True)
        self._server: viser.ViserServer | None = None
        self.port = 0
        """Where it listens, once started."""

    def start(self) -> None:
        """Listen, and say where; a ConfigError if the host is not of this machine, or no port near is free."""
        # A page that is closed while it is being sent something is not a reason to print anything.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        port = free_port(self._options.host, self._options.port)
        scene = self.services.source.record
        name = Path(str(scene.summary.get("root") or LABEL)).name
        server = open_server(self._options.host, port, self._authentication, self._say, f"{name} - {LABEL}")
        self._server, self.port = server, server.get_port()
        server.gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        server.gui.set_panel_label(name)
        server.gui.main_panel.dock_right()  # beside the picture, whose middle is where the object is
        up = up_direction(scene.train_cameras)
        server.scene.set_up_direction(up)
        server.scene.world_axes.visible = False
        camera = (scene.eval_cameras if len(scene.eval_cameras) else scene.train_cameras)[0]
        camera = beside(camera, scene.scene_box, up)
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
            send_what_is_queued(self._server)
        if self.services.videos.is_busy:
            self._say("a video was being rendered and is not kept: the viewer was stopped")
        self.services.stop()
        if self._server is not None:
            with quiet():
                self._server.stop()
        if self._ticker.is_alive():
            self._ticker.join()

    @property
    def sessions(self) -> tuple[Session, ...]:
        """Of the pages that are served."""
        with self._lock:
            return tuple(self._sessions.values())

    def wait(self, while_watched: bool = False) -> None:
        """Serve until Ctrl-C, SIGTERM or SIGHUP, which raise KeyboardInterrupt, or until stopped by another thread;
        `while_watched` ends once no page has been open for so long that one that is loaded again is back, and no video
        is being rendered."""
        unwatched_s = 0
        with _interrupting_signals():
            while not self._stopped.wait(1.0):
                is_needed = bool(self._sessions) or self.services.videos.is_busy
                unwatched_s = 0 if is_needed else unwatched_s + 1
                if while_watched and unwatched_s >= _UNWATCHED_S:
                    return

    def _connected(self, client: viser.ClientHandle) -> None:

        def warn(reason: str) -> None:
            client.gui.add_html(paragraph(reason, is_warning=True))

        with reporting_failures("this page could not be served", warn):
            browser = _browser_of(client)
            session = Session(client, self.services, self._kept_pages.take(browser), browser)
            with self._lock:
                if self._stopped.is_set() or client.client_id in self._sessions:
                    return
                self._sessions[client.client_id] = session
            try:
                session.open(panels_of(self.services))
            finally:  # where the page left meanwhile, opening may have failed for it
                if self._server is not None and client.client_id not in self._server.get_clients():
                    self._disconnected(client)  # it left before it was noted

    def _disconnected(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            self._kept_pages.leave(session.browser, session.state)  # first, since a reload may be back by now
            session.close()

    def _tick(self) -> None:
        while not self._stopped.wait(_TICK_S):
            with reporting_failures("panels could not be renewed", self._say):
                self.services.tick()
                for session in self.sessions:
                    session.tick()


@contextmanager
def _interrupting_signals() -> Iterator[None]:
    """Context in which Ctrl-C, SIGTERM and SIGHUP all raise KeyboardInterrupt, and are the usual way to end, no reason
    for an exit code of theirs; signals that are ignored, as under nohup, stay ignored."""
    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
