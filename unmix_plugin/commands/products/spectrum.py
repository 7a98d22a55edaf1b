"""`unmix-export spectrum`."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from unmix_plugin.commands.products.product import Job, Product
from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.library.material_library import Comparison

if TYPE_CHECKING:
    import numpy as np

    from unmix_plugin.products.spectrum import ProbedPlace
    from unmix_plugin.trained.probe import Probe
    from unmix_plugin.trained.run_views import RunView


@dataclass(frozen=True)
class Spectrum(Product):
    """Spectrum of a pixel (--view 3 --pixel 120,80) or of a point of space (--point=0.1,-0.2,0.5): predicted, and
    measured where the scene is at hand, as CSV and plot; abundances and nearest known materials as JSON."""

    name = "spectrum"

    view: str | None = None
    """View of the pixel: its name, or its number in the scene, from 0."""
    pixel: str | None = None
    """Column and row, from 0 at the top left, as in 120,80."""
    point: str | None = None
    """Point in the scene's world coordinates, as in 0.1,0.2,0.5."""
    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it."""
    library: tuple[Path, ...] = ()
    """Own reflectances to compare with too: .csv files or ENVI spectral libraries."""
    compare: Comparison = "scale"
    """How spectra are compared with known ones: by their shape, or after removal of the continuum."""

    def write(self, job: Job) -> list[Path]:
        """Probe the place and write what is there."""
        from unmix_plugin.products.spectrum import spectrum_paths, write_spectrum

        if self.point is not None and self.view is None and self.pixel is None:
            point = _numbers(self.point, 3, "--point", "0.1,0.2,0.5")
            name = f"point_{'_'.join(f'{value:g}' for value in point)}"
            job.claim(spectrum_paths(job.folder, name))
            place = self._point(job, (point[0], point[1], point[2]))
        elif self.point is None and self.view is not None and self.pixel is not None:
            column, row = _whole_numbers(self.pixel)
            view, index = _view(job, self.view)
            name = f"{view.name}_x{column}_y{row}"
            job.claim(spectrum_paths(job.folder, name))
            place = self._pixel(job, view, index, (column, row))
        else:
            raise ConfigError("give a pixel with --view and --pixel, or else a point with --point")
        return write_spectrum(job.folder, name, place, job.materials)

    def _pixel(self, job: Job, view: RunView, index: int | None, pixel: tuple[int, int]) -> ProbedPlace:
        from unmix_plugin.trained.probe import probe_pixel

        probe = probe_pixel(job.model, view.camera, pixel, job.frame)
        facts = {"view": view.name, "pixel": list(pixel)}
        title = f"{view.name}, column {pixel[0]}, row {pixel[1]}"
        return self._place(job, title, facts, probe, self._measured(job, index, pixel))

    def _point(self, job: Job, point: tuple[float, float, float]) -> ProbedPlace:
        from unmix_plugin.trained.probe import probe_point

        probe = probe_point(job.model, point, job.frame)
        title = f"point {', '.join(f'{value:g}' for value in point)}"
        return self._place(job, title, {"point": list(point)}, probe, None)

    def _place(
        self, job: Job, title: str, facts: dict[str, object], probe: Probe, measured: np.ndarray | None
    ) -> ProbedPlace:
        from unmix_plugin.products.spectrum import ProbedPlace
        from unmix_plugin.spectral.composition import OCCUPIED_ACCUMULATION
        from unmix_plugin.spectral.library.material_library import library_with
        from unmix_plugin.trained.library_matches import LIGHT_UNKNOWN, light_of, shown_matches

        light = light_of(job.model)
        if light is None:
            job.say(LIGHT_UNKNOWN)
        if probe.opacity < OCCUPIED_ACCUMULATION:
            job.say(f"hardly anything is there: opacity {probe.opacity:.2f}")
            return ProbedPlace(title, facts, probe, measured, ())
        library, bands = library_with(self.library), job.materials.bands
        spectra = probe.spectra["predicted"][None]
        [matches] = shown_matches(spectra, bands, light, library, comparison=self.compare)
        return ProbedPlace(title, facts, probe, measured, matches)

    def _measured(self, job: Job, index: int | None, pixel: tuple[int, int]) -> np.ndarray | None:
        """What the scene has in a pixel, in the light asked for."""
        from unmix_plugin.trained.find_scene import scene_at_hand
        from unmix_plugin.trained.library_matches import light_of, relit

        with job.working("looking for the scene"):
            scene = scene_at_hand(job.loaded.scene.summary, job.loaded.run.path, self.data)
        if scene is None or index is None:
            job.say("the scene is not at hand: no measured spectrum (--data says where it is)")
            return None
        recorded, light = job.loaded.scene.summary.get("illuminant"), light_of(job.model)
        return relit(scene.cube(index)[pixel[1], pixel[0]], recorded, light)


def _view(job: Job, wanted: str) -> tuple[RunView, int | None]:
    """A view by its name or number, and its index in the scene, if the run knows it."""
    import difflib

    views = {view.name: view for view in job.views("all")}
    frames = job.loaded.scene.summary.get("frames")
    names = [str(name) for name in frames] if isinstance(frames, list) else list(views)
    name = names[int(wanted)] if wanted.isdecimal() and int(wanted) < len(names) else wanted
    if name not in views:
        near = difflib.get_close_matches(wanted, views, n=3, cutoff=0.4)
        hint = f"; nearest: {', '.join(near)}" if near else ""
        raise ConfigError(
            f"the run has no view {wanted!r}{hint}; give a name or a number from 0 to {len(names) - 1}"
        )
    return views[name], names.index(name) if isinstance(frames, list) else None


def _numbers(text: str, count: int, option: str, example: str) -> list[float]:
    try:
        values = [float(part) + 0.0 for part in text.split(",")]  # no minus before a 0
    except ValueError:
        values = []
    if len(values) != count or not all(abs(value) < float("inf") for value in values):
        raise ConfigError(f"{option} {text} is not {count} numbers with commas between, such as {example}")
    return values


def _whole_numbers(text: str) -> tuple[int, int]:
    if not re.fullmatch(r"\s*\d+\s*,\s*\d+\s*", text):
        raise ConfigError(f"--pixel {text} is not a column and a row from 0, such as 120,80")
    column, row = text.split(",")
    return int(column), int(row)
