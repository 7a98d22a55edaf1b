"""A scene whose views are written: what its cameras see, what looks wrong, and what was decided and done in words."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from unmix_plugin.captures.calibration.bands import BandFault
from unmix_plugin.captures.checks import (
    SeenView,
    ViewSample,
    angles_between,
    check_files,
    check_values,
    check_views,
    find_copies,
)
from unmix_plugin.captures.cube import CaptureView
from unmix_plugin.captures.match_checks import MatchedScene, check_matches
from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.plan import Plan
from unmix_plugin.captures.poses.line_motion import averaged_lines, middle_of
from unmix_plugin.captures.posing import PosedViews
from unmix_plugin.captures.report import Kind, Remark, sentences
from unmix_plugin.captures.writing.view_files import BackgroundRule, ViewRecord
from unmix_plugin.engine.decisions import UNDECIDED, Decision
from unmix_plugin.errors import counted, name_some

_MOST_LISTED, _MOST_BANDS = 4, 8
"""Views that are left out, and bands left out for one reason, that the table of decisions names."""


@dataclass(frozen=True)
class WrittenViews:
    """The views of a capture, written as planned, with those that have turned out not to belong to the scene."""

    folder: Path
    """Of the scene."""
    plan: Plan
    options: ProcessOptions
    records: Mapping[str, ViewRecord]
    """What was written for each view, by name."""
    left_out: Mapping[str, Remark]
    """Why views are left out of the scene, by name; some of them are written."""

    def without(self, remarks: Mapping[str, Remark]) -> WrittenViews:
        """The scene without some more views, unless they are left out already or the user keeps them."""
        kept = {*self.left_out, *self.options.keep_view}
        added = {name: remark for name, remark in remarks.items() if name not in kept}
        return replace(self, left_out={**self.left_out, **added})

    def remaining(self, views: Iterable[CaptureView]) -> tuple[CaptureView, ...]:
        """Those views that are not left out."""
        return tuple(view for view in views if view.name not in self.left_out)

    @property
    def sound(self) -> dict[str, ViewRecord]:
        """What was written for the views that are not left out."""
        return {name: record for name, record in self.records.items() if name not in self.left_out}

    def seen(self, posed: PosedViews) -> list[SeenView]:
        """The views that have poses and are written, with the lenses of their pictures."""
        seen = []
        for view in posed.views:
            if view.name in self.records:
                record, camera = self.records[view.name], posed.poses.cameras[view.name]
                assert camera.lens is not None
                raster = self.plan.sensors[view.sensor].calibration.raster
                camera = replace(camera, lens=raster.lens(camera.lens))
                if camera.lines is not None:
                    lines = averaged_lines(camera.lines, raster.top, raster.height, raster.binning)
                    camera = replace(camera, camera_to_world=middle_of(lines), lines=lines)
                seen.append(SeenView(record, camera, self.folder / record.paths["file_path"]))
        return seen


@dataclass(frozen=True)
class Findings:
    """What the checks of a written scene found, one sentence each."""

    wrong: list[str]
    measured: list[str]


def examine(written: WrittenViews, posed: PosedViews) -> Findings:
    """What looks wrong with the scene, and what was measured, of places, pictures, values, poses and lens."""
    plan, seen = written.plan, written.seen(posed)
    ((greatest, _),) = Counter(view.record.sensor for view in seen).most_common(1)
    # Views of sensors with other bands can't be compared with those of the one that took the most.
    bands_nm = plan.sensors[greatest].centers_nm
    alike = {name for name, sensor in plan.sensors.items() if np.array_equal(sensor.centers_nm, bands_nm)}
    checked = check_views([view for view in seen if view.record.sensor in alike], posed.poses.points)
    checked += [
        *find_copies(seen, written.folder),
        *posed.remarks,
        *check_files(posed.views, written.options),
    ]
    for name, sensor in plan.sensors.items():
        same = [view for view in seen if view.record.sensor == name]
        samples = [ViewSample.of(view.record, written.folder) for view in same]
        checked += check_values(samples, angles_between(same), sensor.centers_nm)
    # Between pictures of line cameras nothing is matched, as no fundamental matrix explains them.
    matched = MatchedScene((), None)
    if all(view.camera.lines is None for view in seen):
        pictures = [(view.camera, view.picture) for view in seen if view.record.sensor == greatest]
        matched = MatchedScene.of(pictures)
    checked += check_matches(matched)
    wrong = sentences(written.left_out.values(), Kind.WRONG)
    wrong += dict.fromkeys((*sentences(plan.remarks, Kind.WRONG), *posed.poses.warnings))
    return Findings(wrong + sentences(checked, Kind.WRONG), sentences(checked, Kind.MEASURED))


def decisions_of(written: WrittenViews, posed: PosedViews) -> list[Decision]:
    """The table of all that was decided: what, from what, what would have spoken against it and was looked for, and the
    option that overrides it. Decisions on single sensors have their names."""
    plan, options = written.plan, written.options
    reasons = {
        name: remark.code.name.removeprefix("VIEW_").lower() for name, remark in written.left_out.items()
    }
    listed = {name: reasons[name].replace("_", " ") for name in [*reasons][:_MOST_LISTED]}
    more = {"others": len(reasons) - len(listed)} if len(reasons) > len(listed) else {}
    used = len(posed.views)
    decisions = [
        Decision(
            "views",
            f"{used} used, {len(reasons)} left out" if reasons else f"all {used} are used",
            {**listed, **more},
            "neighbours that are alike, or more than a quarter of the views",
            "--keep-view, --leave-out",
        )
    ]
    for name, sensor in plan.sensors.items():
        where, references = f" of {name}" if name else "", sensor.references_used
        for key, what, outcome, against in (
            ("dark", "dark frame", "subtracted", "values that pile up below 0"),
            (
                *("white", "white reference", "divided by"),
                "bands in which it is saturated, dark, or not above the dark frame",
            ),
        ):
            if key in references:
                decisions.append(Decision(f"{what}{where}", outcome, references[key], against, f"--{key}"))
        exposure, brought = sensor.calibration.exposure, "not compared"
        if exposure is not None:
            ends = dict.fromkeys(f"{number:g}" for number in (exposure.min(), exposure.max()))
            brought = f"all brought to {' to '.join(ends)} s"
        stored, nm = sensor.saturation.stored, sensor.bands.wavelengths_nm
        dropped: dict[str, list[str]] = defaultdict(list)
        for index, band in sorted(sensor.bands.dropped.items()):
            reason = "noisy" if band.fault is BandFault.NOISY else band.reason
            dropped[reason].append(f"{nm[index]:g} nm")
        decisions += [
            Decision(
                f"values{where}",
                sensor.meaning.description,
                {"wavelengths from": sensor.bands.source},
                flag="--wavelengths, --white",
            ),
            Decision(
                f"exposure{where}",
                brought,
                {},
                "a time, gain or f-number that one file states and another lacks; values that are reflectance already",
            ),
            Decision(
                f"saturation{where}",
                UNDECIDED if stored is None else f"from {stored:g}",
                {"from": sensor.saturation.reason},
                "numbers that are not whole, or none that crowd at the greatest",
                "--saturation",
            ),
            Decision(
                f"bands{where}",
                f"{len(sensor.bands.kept)} of {len(nm)} kept",
                {reason: f"({name_some(names, _MOST_BANDS)})" for reason, names in dropped.items()},
                f"more than half of the bands noisier than {options.max_noise:g} of their signal",
                "--drop-bands, --max-noise",
            ),
        ]
    above = max(
        (float((sensor.sample > plan.scale.value).mean()) for sensor in plan.sensors.values()), default=0.0
    )
    rules = [r.background for r in plan.recipes.values() if isinstance(r.background, BackgroundRule)]
    levels = ", ".join(f"{rule.level:.3f} (threshold {rule.threshold:.3f})" for rule in rules)
    masks = {
        "auto": "a backdrop that all views share is cut out",
        "files": "from files",
        "none": "none: all of each view is the scene",
    }
    is_estimated = not posed.poses.has_world
    has_lines = any(camera.lines is not None for camera in posed.poses.cameras.values())
    return [
        *decisions,
        Decision(
            "scale",
            f"{plan.scale.value:g} is written as 1",
            {"sampled values above": above, "from": plan.scale.reason},
            "views that are far brighter than most, which it does not follow",
            "--scale",
        ),
        Decision(
            "mask",
            masks.get(plan.mask, plan.mask),
            {
                "asked": options.mask,
                **({"backdrop": plan.backdrops_in_words} if plan.backdrops_in_words else {}),
                **({"background at": levels} if levels else {}),
            },
            "borders with texture, or that differ between views" if options.mask == "auto" else "",
            "--mask",
        ),
        Decision(
            "poses",
            f"{'estimated' if is_estimated else 'read'}: {posed.poses.source}",
            {"views": used},
            "cameras that jump between lines, or look away from each other"
            if has_lines
            else "points shared by views that lie elsewhere by the poses",
            "--poses" if options.poses is None or not is_estimated else "--poses FILE",
        ),
    ]


def what_was_done(written: WrittenViews, posed: PosedViews) -> list[str]:
    """Totals of what was written, and what was done on the way, one sentence each; `decisions_of` tells why."""
    plan, views = written.plan, [view.record for view in written.seen(posed)]

    def total(what: str) -> str:
        noun = what.rpartition("_")[2].removesuffix("s")
        return counted(sum(getattr(view, what) for view in views), noun)

    num_values = sum(view.num_pixels * len(plan.sensors[view.sensor].centers_nm) for view in views)
    negative = sum(view.negative_values for view in views) / max(num_values, 1)
    values = (
        f"{total('saturated_pixels')} with saturated bands, which are written as 1; {total('clipped_values')} above 1, "
        f"written as 1 too; {total('negative_values')} below 0 ({negative:.1%} of all), written as 0; "
        f"{total('missing_pixels')} masked, as nothing was measured there"
    )
    lines = [values]
    if plan.mask != "none" or plan.backdrops_in_words:
        line = f"{np.mean([view.matter_share for view in views]):.0%} of the pixels are foreground"
        if plan.mask != "files":
            line += f", the rest is cut out; {total('specks')} removed, {total('holes')} filled"
        whole = sum(view.matter_share == 1.0 for view in views)
        if plan.backdrops_in_words and whole:
            line += f"; {counted(whole, 'view')} without any backdrop"
        lines.append(line)
    return [*lines, *(text for one in (posed, plan) for text in sentences(one.remarks, Kind.DONE))]
