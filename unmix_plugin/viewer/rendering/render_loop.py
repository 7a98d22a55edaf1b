"""When to render: one thread that serves all clients, block by block, the most urgent first.

A camera that moved is answered with a small picture, never interrupted; a client at rest gets finer ones, in blocks so
short that anything more urgent comes between; a change of layer is painted from the coefficients of the last picture.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.gradual import FrameRender, wants_more
from unmix_plugin.trained.protocol import RenderedView
from unmix_plugin.viewer.page import reporting_failures
from unmix_plugin.viewer.rendering.pictures import (
    DEFAULT_HEIGHT,
    RESTING_COST,
    Picture,
    PictureMaker,
)
from unmix_plugin.viewer.rendering.scene import Edit
from unmix_plugin.viewer.rendering.settings import LayerSettings
from unmix_plugin.viewer.view_cameras import ViewPose

_POLL_S = 0.05
_JOIN_S = 20.0
_STRIP_PIXELS = 1 << 17
"""Pixels of a capture that are held at once."""


@dataclass(eq=False)
class View:
    """What one client looks at, and how far its picture has come; changed only under the loop's lock."""

    show: Callable[[Picture], None]
    """Sends a picture."""
    report: Callable[[str], None]
    """Says what went wrong; an empty text that all is well again."""
    settings: LayerSettings = LayerSettings()
    edit: Edit = Edit()
    largest_height: int = DEFAULT_HEIGHT
    """Rows of the finest picture."""
    subpixels: int = 1
    """Rays through a pixel of the finest picture, along each of its edges."""
    wants_depth: bool = False
    """Whether objects of the client's own are to be hidden behind what is seen."""
    pose: ViewPose | None = None
    frame: RenderedView | None = None
    """The picture shown last."""
    frame_edit: Edit = Edit()
    """What `frame` was rendered with."""
    frame_version: int = -1
    """The model's version that `frame` shows."""
    moved_at: float | None = None
    """When the first change without a picture yet came that needs rendering; None if there is none."""
    restyled_at: float | None = None
    """The same for changes that need no rendering."""
    render: FrameRender | None = None
    """The finer picture under way."""
    render_version: int = -1
    served_at: float = 0.0
    """When a block was last rendered for it."""
    shown_at: float = 0.0
    is_stuck: bool = False
    """Whether its last picture failed; it is tried again once something changes."""
    has_reported: bool = False
    """Whether its client was told of a failure."""

    @property
    def _asked_at(self) -> float | None:
        """Since when it waits for a picture at once."""
        return self.restyled_at if self.moved_at is None else self.moved_at


class RenderLoop:
    """Renders for all views until stopped; nothing that goes wrong in a picture ends it."""

    def __init__(self, maker: PictureMaker) -> None:
        self._maker = maker
        self._changed = threading.Condition()
        self._views: list[View] = []
        self._is_stopping = False
        self._queue: deque[object] = deque()
        """Pictures rendered in strips that wait for their next block."""
        self._num_blocks = 0
        """Of such pictures, that are rendered at this moment."""
        self._thread = threading.Thread(target=self._run, name="unmix-viewer-render", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def stop(self) -> None:
        """End after the blocks under way, also those of pictures that are rendered in strips."""
        with self._changed:
            self._is_stopping = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)
        # A thread in native code when the interpreter ends takes the process down with it.
        with self._changed:
            self._changed.wait_for(lambda: self._num_blocks == 0, _JOIN_S)

    def add(self, view: View) -> None:
        """Serve a view."""
        with self._changed:
            self._views.append(view)

    def remove(self, view: View) -> None:
        """Forget a view, also one whose picture is under way."""
        with self._changed:
            if view in self._views:
                self._views.remove(view)
            view.render = view.frame = None
            self._changed.notify_all()

    def change(self, view: View, **what: Any) -> None:
        """Show a view with other values of its fields; it is rendered again only where shape, gloss or rays change."""
        with self._changed:
            for name, value in what.items():
                setattr(view, name, value)
            view.is_stuck = False
            is_other_shape = "edit" in what and not view.edit.reuses(view.frame_edit)
            if is_other_shape or what.keys() & {"pose", "largest_height", "subpixels"}:
                view.render, view.moved_at = None, view.moved_at or time.monotonic()
            else:
                view.restyled_at = view.restyled_at or time.monotonic()
            self._changed.notify_all()

    def strips(
        self,
        camera: Cameras,
        edit: Edit,
        subpixels: int,
        cancelled: threading.Event,
        show: Callable[[float], None] = lambda _: None,
        most_pixels: int | None = None,
    ) -> Iterator[RenderedView]:
        """A picture of any size apart from any view: strips from top to bottom, each rendered in the caller's thread
        when nothing is more urgent, in turn with other such pictures. `show` is told the part that is rendered; a strip
        has at most `most_pixels` where its width allows. A ConfigError once it is `cancelled` or the loop stopped,
        another UnmixError if the edit does not fit the run."""
        rows = max(1, (most_pixels or _STRIP_PIXELS) // camera.width)
        for first in range(0, camera.height, rows):
            part = camera.crop(0, first, camera.width, min(rows, camera.height - first))
            render, frame = FrameRender(part, subpixels, is_finished=True), None
            while frame is None:
                with self._turn(cancelled):
                    frame = self._maker.advance(render, edit, self._maker.speed.block_rays, RESTING_COST)
                show((first + part.height * (1 - render.rays_left / render.num_rays)) / camera.height)
            yield frame

    @contextmanager
    def _turn(self, cancelled: threading.Event) -> Iterator[None]:
        """Context for a block of a picture in strips: entered when no view waits for a picture at once, and pictures
        that have waited longer have had a block."""
        turn = object()
        with self._changed:
            self._queue.append(turn)
            while not (self._is_stopping or cancelled.is_set()):
                if not self._waiting and self._queue[0] is turn:
                    break
                self._changed.wait(_POLL_S)
            self._queue.remove(turn)
            self._changed.notify_all()
            if self._is_stopping or cancelled.is_set():
                raise ConfigError("the viewer was stopped" if self._is_stopping else "cancelled")
            self._num_blocks += 1
        try:
            yield
        finally:
            with self._changed:
                self._num_blocks -= 1
                self._changed.notify_all()

    def step(self) -> bool:
        """Do the most urgent piece of work; False if there is none at this moment."""
        with self._changed:
            unit = self._next_unit()
        if unit is not None:
            unit()
        return unit is not None

    def _run(self) -> None:
        while True:
            with self._changed:
                while (unit := None if self._is_stopping else self._next_unit()) is None:
                    if self._is_stopping:
                        return
                    self._changed.wait(_POLL_S if self._views else None)
            unit()

    @property
    def _active(self) -> list[View]:
        return [view for view in self._views if view.pose is not None and not view.is_stuck]

    @property
    def _waiting(self) -> list[View]:
        return [view for view in self._active if view._asked_at is not None]

    def _next_unit(self) -> Callable[[], None] | None:
        """What is most urgent: answers in the order in which they were asked for, then blocks in turn."""
        if waiting := self._waiting:
            first = min(waiting, key=lambda view: view._asked_at or 0.0)
            return lambda: self._guarded(first, self._answer if first.moved_at is not None else self._redraw)
        if not self._maker.source.device.viewing_may_go:
            return None
        unfinished = [view for view in self._active if self._has_more(view)]
        served = min(unfinished, key=lambda view: view.served_at, default=None)
        return None if served is None else lambda: self._guarded(served, self._refine)

    def _has_more(self, view: View) -> bool:
        if view.render is not None or view.frame is None or view.pose is None:
            return view.render is not None
        if view.frame.camera.height < self._maker.target_height(view.pose, view.largest_height):
            return True
        if view.frame_version == self._maker.source.version:
            return wants_more(view.frame)
        return time.monotonic() - view.shown_at > _POLL_S

    def _guarded(self, view: View, work: Callable[[View], None]) -> None:
        """Do a piece of work for a view; what goes wrong is said to its client, and the loop goes on."""

        def fail(reason: str) -> None:
            with self._changed:
                view.is_stuck = view.has_reported = True
                view.render = view.moved_at = view.restyled_at = None
            view.report(reason)

        with reporting_failures("this picture failed", fail):
            work(view)

    def _answer(self, view: View) -> None:
        with self._changed:
            pose, edit, height = view.pose, view.edit, view.largest_height
            view.moved_at = view.restyled_at = None
            version = self._maker.source.version
        assert pose is not None
        render = self._maker.first_render(pose, height)
        frame = self._maker.advance(render, edit, render.num_rays, cost=1.0)
        assert frame is not None
        self._present(view, frame, edit, version)

    def _refine(self, view: View) -> None:
        """A block of the next finer picture; the picture itself after its last block."""
        with self._changed:
            if view.pose is None or view.frame is None:
                return
            if view.render is None:
                view.render = self._maker.finer_render(
                    view.pose, view.frame, view.largest_height, view.subpixels
                )
                view.render_version = self._maker.source.version
            render, edit, version = view.render, view.edit, view.render_version
            view.served_at = time.monotonic()
        frame = self._maker.advance(render, edit, self._maker.speed.block_rays, cost=RESTING_COST)
        with self._changed:
            if frame is None or view.render is not render:
                return  # more is to come, or the camera moved while the last block was rendered
            view.render = None
        self._present(view, frame, edit, version)

    def _redraw(self, view: View) -> None:
        """The last picture in another layer, or with other materials on the same shapes."""
        with self._changed:
            frame, edit, version, view.restyled_at = view.frame, view.edit, view.frame_version, None
        if frame is None:
            return
        if edit is not view.frame_edit:
            frame = self._maker.with_materials_of(edit, frame)
        self._present(view, frame, edit, version)

    def _present(self, view: View, frame: RenderedView, edit: Edit, version: int) -> None:
        with self._changed:
            if view not in self._views or view.pose is None:
                return
            view.frame, view.frame_edit, view.frame_version = frame, edit, version
            settings, wants_depth = view.settings, view.wants_depth
            is_moving = frame.camera.height < self._maker.target_height(view.pose, view.largest_height)
            had_reported = view.has_reported
        started = time.perf_counter()
        shown = self._maker.paint(frame, settings, wants_depth, is_moving)
        view.has_reported = False
        view.show(shown)
        self._maker.source.device.charge(time.perf_counter() - started)
        view.shown_at = time.monotonic()
        if had_reported:
            view.report("")
