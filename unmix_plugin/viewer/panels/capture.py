"""What leaves the viewer: pictures of any size, spectra of the view, camera paths and their videos."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from unmix_plugin.editing import recipe_to_yaml
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError
from unmix_plugin.formats.files import rgba_png_bytes, write_file
from unmix_plugin.trained.camera_files import camera_file_bytes
from unmix_plugin.trained.protocol import RenderedView
from unmix_plugin.trained.run_views import RunView, world_frame
from unmix_plugin.viewer.page import index_in, new_file, number, number_of, reporting_failures
from unmix_plugin.viewer.rendering.captures import (
    SIDE_BOUNDS,
    VideoJob,
    check_size,
    joined_strips,
    render_argv,
    strip_of_spectra,
    write_spectra,
)
from unmix_plugin.viewer.rendering.painting import layer_named
from unmix_plugin.viewer.rendering.settings import LayerSettings
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import ViewPose, camera_of, path_poses, sized_camera

_MOST_KEY_FRAMES = 100
_PREVIEW_FPS = 12
_LARGEST_DOWNLOAD = 1 << 26
_NO_KEYS: tuple[str, ...] = ("none yet",)


class CapturePanel:
    """Saves what a client sees."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._capture: threading.Event | None = None
        """Set to cancel the picture that is being rendered."""
        self._video: VideoJob | None = None
        self._keys: list[ViewPose] = []
        self._preview = threading.Event()
        gui = session.client.gui
        low, high = SIDE_BOUNDS
        with gui.add_folder("picture"):
            self._width, self._height = (
                gui.add_number(label, 1024, min=low, max=high, step=1) for label in ("width", "height")
            )
            self._name = gui.add_text("file name", "view")
            self._progress = gui.add_progress_bar(0.0)
            session.add_button("save a screenshot (PNG)", self._save_picture)
            if session.services.has_materials:
                session.add_button("save the spectra (EXR)", self._save_spectra)
            session.add_button("cancel", self._cancel, "gray")
        with gui.add_folder("camera path"):
            session.add_button("add a key frame here", self._add_key)
            self._key = gui.add_dropdown("key frame", _NO_KEYS)
            session.add_buttons("this one", ("look", "replace", "remove"), self._change_key)
            self._seconds = gui.add_number("seconds", 4.0, min=0.5, max=120.0, step=0.5)
            self._fps = gui.add_number("frames a second", 24, min=1, max=60, step=1)
            session.add_buttons("preview", ("play", "stop"), self._play)
            session.add_button("save the path", lambda: self._say_saved(self._save_path()))
            session.add_button("render a video", self._render_video)
            session.add_button("cancel the video", self._cancel_video, "gray")
            self._video_progress = gui.add_progress_bar(0.0)
        session.on_close += [lambda: self._preview.set(), self._cancel]

    def _show_progress(self, bar: Any, fraction: float) -> None:
        if not self._session.is_closed:
            bar.value = 100.0 * fraction

    def _cancel(self) -> None:
        if self._capture is not None:
            self._capture.set()

    def _camera(self, num_bands: int | None = None) -> Cameras:
        """What the client sees, in the size asked for, which is checked: the vertical field of view stays."""
        width, height = _side(self._width), _side(self._height)
        check_size(width, height, num_bands)
        return sized_camera(self._session.pose(), width, height)

    def _save_picture(self) -> None:
        camera = self._camera()
        settings, maker = self._settings_shown(), self._session.services.maker
        name, what = self._name.value, f"{settings.layer}, {camera.width} x {camera.height} pixels"
        self._begin(
            camera,
            lambda strip: (maker.paint(strip, settings, False, False).picture,),
            lambda picture: write_file(self._new_file(name, ".png"), rgba_png_bytes(picture[0], what)),
        )

    def _settings_shown(self) -> LayerSettings:
        """What the page shows, with the ends of its colours: strips and frames would each have others of their own."""
        settings, ends = self._session.view.settings, self._session.value_range_shown
        return settings if ends is None else replace(settings, value_range=ends)

    def _save_spectra(self) -> None:
        materials = self._session.materials()
        camera, name = self._camera(len(materials.bands)), self._name.value
        self._begin(
            camera,
            strip_of_spectra,
            lambda picture: write_spectra(self._new_file(name, ".exr"), picture, materials),
        )

    def _begin(
        self,
        camera: Cameras,
        read: Callable[[RenderedView], Sequence[np.ndarray]],
        write: Callable[[Sequence[np.ndarray]], Path],
    ) -> None:
        """Render a picture strip by strip in a thread of its own, write what is read of them and hand it over."""
        if self._capture is not None:
            raise ConfigError("a picture is being rendered already; wait for it or cancel it")
        session, view, cancelled = self._session, self._session.view, threading.Event()
        show = partial(self._show_progress, self._progress)
        strips = session.services.loop.strips(camera, view.edit, view.subpixels, cancelled, show)
        self._capture = cancelled

        def work() -> None:
            with reporting_failures("the picture failed", lambda reason: session.warn(reason, "no picture")):
                try:
                    found = joined_strips(map(read, strips), camera.height)
                finally:
                    self._capture = None
                    show(0.0)
                session.guarded(lambda: self._hand_over(write(found)))()

        threading.Thread(target=work, name="unmix-viewer-picture", daemon=True).start()

    def _new_file(self, name: Any, suffix: str) -> Path:
        return new_file(self._session.services.folder, name, suffix, "view")

    def _hand_over(self, path: Path) -> None:
        """Offer a file that was written to the browser as well, if it is not too large."""
        if path.stat().st_size <= _LARGEST_DOWNLOAD:
            self._session.client.send_file_download(path.name, path.read_bytes())
        self._say_saved(path)

    def _say_saved(self, path: Path) -> None:
        self._session.say("saved", f"{path.name} in {path.parent}")  # the ends of long paths are cut off

    def _add_key(self) -> None:
        if len(self._keys) >= _MOST_KEY_FRAMES:
            raise ConfigError(f"a path has at most {_MOST_KEY_FRAMES} key frames")
        self._keys.append(self._session.pose())
        self._list_keys(len(self._keys) - 1)

    def _list_keys(self, chosen: int) -> None:
        count = len(self._keys)
        names = tuple(f"{index + 1} of {count}" for index in range(count)) or _NO_KEYS
        self._key.options = names
        self._key.value = names[min(max(chosen, 0), len(names) - 1)]

    def _change_key(self, action: str) -> None:
        if not self._keys:
            raise ConfigError("there is no key frame yet; add one")
        index = index_in(self._key)
        if action == "look":
            self._session.look_from(camera_of(self._keys[index], 64))
        elif action == "replace":
            self._keys[index] = self._session.pose()
        elif action == "remove":
            del self._keys[index]
            self._list_keys(index)

    def _path(self, frames_per_second: float) -> list[ViewPose]:
        return path_poses(self._keys, max(2, round(number_of(self._seconds, 4.0) * frames_per_second)))

    def _play(self, action: str) -> None:
        """Move the client's camera along the path, in a thread of its own, or stop that."""
        self._preview.set()
        if action == "stop":
            return
        poses = self._path(_PREVIEW_FPS)
        stopped = self._preview = threading.Event()

        def play() -> None:
            for pose in poses:
                if stopped.wait(1 / _PREVIEW_FPS) or self._session.is_closed:
                    return
                self._session.guarded(lambda pose=pose: self._session.look_from(camera_of(pose, 64)))()

        threading.Thread(target=play, name="unmix-viewer-preview", daemon=True).start()

    def _save_path(self) -> Path:
        frames_per_second, services = number_of(self._fps, 24), self._session.services
        width, height = _side(self._width) // 2 * 2, _side(self._height) // 2 * 2
        views = [
            RunView(f"path_{index:04d}", sized_camera(pose, width, height))
            for index, pose in enumerate(self._path(frames_per_second))
        ]
        path = new_file(services.folder, f"{self._name.value}-path", ".json", "path")
        return write_file(
            path, camera_file_bytes(views, frames_per_second, world_frame(services.source.record))
        )

    def _render_video(self) -> None:
        session, services = self._session, self._session.services
        if self._video is not None:
            raise ConfigError("a video is being rendered already; wait for it or cancel it")
        settings, bands = self._settings_shown(), None
        if settings.layer == "error":
            raise ConfigError(
                "videos can't show the layer error, which is against one training view; choose another one"
            )
        if services.has_materials:
            bands = session.materials().bands
        output = layer_named(settings.layer, services.maker.layers).output_name(settings, bands)
        check_size(_side(self._width), _side(self._height))
        cameras = self._save_path()
        recipe = None
        if session.view.edit.has_recipe:
            text = recipe_to_yaml(session.view.edit.recipe).encode()
            recipe = write_file(cameras.with_suffix(".yml"), text)
        folder = cameras.with_suffix("")
        argv = render_argv(
            services.source.run.path, cameras, output, settings, folder, recipe, session.view.edit.light
        )
        show = partial(self._show_progress, self._video_progress)

        def done(video: Path | None, reason: str) -> None:
            self._video = None
            show(0.0)
            if video is None:
                session.warn(reason, "no video")
            else:
                session.guarded(lambda: self._hand_over(video))()

        self._video = VideoJob(argv, folder, show, done)
        services.videos.start(self._video)
        session.say(
            "video",
            f"unmix-render writes it to {folder}, after those of other pages, also when this page is closed",
        )

    def _cancel_video(self) -> None:
        if self._video is not None:
            self._session.services.videos.cancel(self._video)


def _side(control: Any) -> int:
    """A width or height that was typed; a ConfigError if it is out of bounds."""
    low, high = SIDE_BOUNDS
    found = number(control.value, -math.inf, math.inf, fallback=0)
    if not low <= found <= high:
        raise ConfigError(f"{control.label} is a number of pixels from {low} to {high}; found {found:g}")
    return int(found)
