"""One HTML file about a run: everything that it learnt and how well, to read, to send or to print."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unmix_plugin.errors import ConfigError
from unmix_plugin.products.product import Job, Product

if TYPE_CHECKING:
    from unmix_plugin.products.report.views import ReportViews
    from unmix_plugin.scenes.scene import Scene
    from unmix_plugin.trained.run_views import RunView

_VIEWS_WITH_SHARES = 2


@dataclass(frozen=True)
class Report(Product):
    """One HTML file about the run, report.html, which needs nothing else: scene, views, materials with their nearest
    known ones, abundances, segmentation, figures of merit, errors, training, settings. Measured images and labels are
    shown where the scene folder is found."""

    name = "report"

    max_views: int = 24
    """Most evaluation views to render; of more, an even choice."""
    data: Path | None = None
    """Scene folder, where it is no longer where the run was trained on it."""
    library: tuple[Path, ...] = ()
    """Own reflectances to compare with too: .csv files or ENVI spectral libraries."""

    def write(self, job: Job) -> list[Path]:
        """Render, compare and lay out."""
        from unmix_plugin.products.report.layout import write_report
        from unmix_plugin.products.report.views import evenly
        from unmix_plugin.trained.library_matches import library_with

        if self.max_views < 1:
            raise ConfigError(f"--max-views is {self.max_views}; choose at least 1")
        job.claim([report_path(job.folder)])
        library = library_with(self.library)
        chosen = evenly(job.views("eval"), self.max_views)
        views, notes = self._look(job, chosen), []
        if self._is_edited:
            notes.append(
                "Edited: what is rendered here is the run with the edits or the light asked for; figures and training "
                "are those of the run itself."
            )
        if len(chosen) < len(job.loaded.record.eval_cameras):
            notes.append(
                f"Rendered: {len(chosen)} of {len(job.loaded.record.eval_cameras)} evaluation views."
            )
        with job.working("laying out the report"):
            return [write_report(job.folder, job.loaded, views, library, _stored_figures(job), notes)]

    @property
    def _is_edited(self) -> bool:
        return self.edits is not None or self.illuminant is not None

    def _look(self, job: Job, chosen: list[RunView]) -> ReportViews:
        """Render the views, and compare each with what was measured, if the scene folder is found and unchanged."""
        from unmix_plugin.products.report.views import ReportViews, evenly
        from unmix_plugin.trained.evaluation import Evaluation, scene_truth, view_truth

        materials, scene = job.materials, self._scene(job)
        evaluation = None
        if scene is not None:
            evaluation = Evaluation(scene_truth(scene), materials.endmembers, materials.names)
        with_shares = {view.name for view in evenly(chosen, _VIEWS_WITH_SHARES)}
        views = ReportViews(materials, evaluation, with_shares)
        indices = {} if scene is None else {frame.name: index for index, frame in enumerate(scene.frames)}
        for view in job.follow("rendering views", chosen):
            truth = None if scene is None else view_truth(scene, indices[view.name])
            if truth is not None and truth.sensor is not None:
                truth = None  # of a rig, only views with all bands are put beside the prediction
            views.add(view.name, job.render(view), truth)
        return views

    def _scene(self, job: Job) -> Scene | None:
        from unmix_plugin.trained.find_scene import find_scene

        if self._is_edited:
            return None
        with job.working("looking for the scene"):
            scene = find_scene(job.loaded.record.summary, job.loaded.folder.path, self.data)
        if scene is None:
            job.say("the scene folder was not found: nothing measured in the report; give it with --data")
        return scene


def report_path(folder: Path) -> Path:
    """The file that `write_report` makes."""
    return folder / "report.html"


def _stored_figures(job: Job) -> dict[str, Any] | None:
    """What `unmix-eval` found, if it was run."""
    path = job.loaded.folder.eval / "metrics.json"
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
