"""The regions of a run while pages are drawn: kept in its folder, measured on a surface that is found once for all."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from unmix_plugin.errors import ConfigError
from unmix_plugin.trained.measured_surface import MeasuredRegion, MeasuredSurface
from unmix_plugin.trained.measures import keep_region, measures_path, read_measures
from unmix_plugin.trained.regions import Region, region_to_json
from unmix_plugin.trained.trained_scene import TrainedScene
from unmix_plugin.viewer.rendering.pictures import PictureMaker
from unmix_plugin.viewer.rendering.scene import Edit

_STOP_S = 20.0
"""How long a turn under way is waited for."""


class RunRegions:
    """The regions kept with a run, and what they are on its surface, which is found when it is first asked for."""

    def __init__(self, maker: PictureMaker) -> None:
        self._maker, self._source = maker, maker.source
        self._measuring = threading.Lock()
        self._is_stopping = False
        self._surface: MeasuredSurface | None = None
        self._measured: dict[str, tuple[MeasuredRegion, MeasuredSurface]] = {}
        """By what a region is, as JSON: names may be given anew."""

    @property
    def kept(self) -> Mapping[str, Region]:
        """By name, as they are by now: commands and other pages keep some, too."""
        return read_measures(self._source.run).regions

    @property
    def changed_at(self) -> int:
        """When what is kept with the run was written last, in ns; 0 where nothing is."""
        path = measures_path(self._source.run)
        return path.stat().st_mtime_ns if path.exists() else 0

    def measured(self, region: Region) -> tuple[MeasuredRegion, MeasuredSurface] | None:
        """What a region is, and on which surface; None if it was not measured yet."""
        return self._measured.get(json.dumps(region_to_json(region)))

    def measure(self, name: str, region: Region, show: Callable[[str], None]) -> MeasuredRegion:
        """What a region of the unedited scene is; `show` is told how far it is, since the first one takes long. A
        ConfigError while training goes on or if no surface is in it, a RunError if no camera sees one."""
        self._source.require_final("measure regions")
        with self._measuring:
            surface = self._surface = self._surface or self._find_surface(show)
            show(f"measuring {name}")
            with self._turn():
                found = surface.measure(region, name)
            self._measured[json.dumps(region_to_json(region))] = (found, surface)
            return found

    def keep(self, name: str, region: Region | None) -> None:
        """Keep a region with the run, in place of one of its name, None removes that; a ConfigError if the name can't
        be one, or there are too many."""
        keep_region(self._source.run, name, region)

    def stop(self) -> None:
        """End what is measured, and refuse to measure from now on."""
        self._is_stopping = True
        if self._measuring.acquire(timeout=_STOP_S):
            self._measuring.release()

    def _find_surface(self, show: Callable[[str], None]) -> MeasuredSurface:
        """The surface, found in many short turns on the device, between which pages are drawn."""
        with self._turn() as scene:
            pass

        def follow(doing: str, items: Sequence[Any]) -> Iterator[Any]:
            for index, item in enumerate(items):
                show(f"{doing}: {index} of {len(items)}")
                with self._turn():
                    yield item

        @contextmanager
        def working(doing: str) -> Iterator[None]:
            show(doing)
            with self._turn():
                yield

        return MeasuredSurface.of(scene, follow, working)

    @contextmanager
    def _turn(self) -> Iterator[TrainedScene]:
        """The device and the unedited scene, after pages that wait; a ConfigError once stopped."""
        if self._is_stopping:
            raise ConfigError("the viewer was stopped")
        with self._maker.locked_edit(Edit()) as (scene, _):
            yield scene
