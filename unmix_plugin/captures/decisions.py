"""The table of all that was decided on a capture: what, from what, what would have spoken against it and was looked
for, and the option that overrides it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from unmix_plugin.captures.options import ProcessOptions
from unmix_plugin.captures.plan import Plan, SensorPlan
from unmix_plugin.captures.posing import PosedViews
from unmix_plugin.captures.report import Remark
from unmix_plugin.engine.decisions import UNDECIDED, Decision
from unmix_plugin.scenes.backdrops import Backdrop

_MOST_LISTED = 4


def decisions_of(
    plan: Plan, posed: PosedViews, left_out: Sequence[Remark], options: ProcessOptions
) -> list[Decision]:
    """All decisions, those on single sensors with their names."""
    reasons = {remark.where[0]: remark.code.name.removeprefix("VIEW_").lower() for remark in left_out}
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
        decisions += _of_sensor(f" of {name}" if name else "", sensor, options)
    above = max(
        (float((sensor.sample > plan.scale.value).mean()) for sensor in plan.sensors.values()), default=0.0
    )
    decisions.append(
        Decision(
            "scale",
            f"{plan.scale.value:g} is written as 1",
            {"sampled values above": above, "from": plan.scale.reason},
            "views that are far brighter than most, which it does not follow",
            "--scale",
        )
    )
    decisions.append(_of_mask(plan, options))
    is_estimated = not posed.poses.has_world
    decisions.append(
        Decision(
            "poses",
            f"{'estimated' if is_estimated else 'read'}: {posed.poses.source}",
            {"views": used},
            "cameras that jump between lines, or look away from each other"
            if any(camera.lines is not None for camera in posed.poses.cameras.values())
            else "points shared by views that lie elsewhere by the poses",
            "--poses" if options.poses is None or not is_estimated else "--poses FILE",
        )
    )
    return decisions


def _of_sensor(where: str, sensor: SensorPlan, options: ProcessOptions) -> Iterator[Decision]:
    facts = sensor.references_used
    for key, what, against in (
        ("dark", "dark frame", "values that pile up below 0"),
        ("white", "white reference", "bands in which it is saturated, dark, or not above the dark frame"),
    ):
        if key in facts:
            used = {"file": facts[key]["file"], "use": facts[key]["use"]}
            yield Decision(
                f"{what}{where}",
                "subtracted" if key == "dark" else "divided by",
                used,
                against,
                f"--{key}",
            )
    exposure, brought = sensor.calibration.exposure, "not compared"
    if exposure is not None:
        ends = dict.fromkeys(f"{number:g}" for number in (exposure.min(), exposure.max()))
        brought = f"all brought to {' to '.join(ends)} s"
    yield Decision(
        f"exposure{where}",
        brought,
        {},
        "a time, gain or f-number that one file states and another lacks; values that are reflectance already",
    )
    stored, reason = sensor.saturation.stored, sensor.saturation.reason
    yield Decision(
        f"saturation{where}",
        UNDECIDED if stored is None else f"from {stored:g}",
        {"from": reason},
        "numbers that are not whole, or none that crowd at the greatest",
        "--saturation",
    )
    dropped = sensor.bands.dropped
    nm = sensor.bands.wavelengths_nm
    some = [(index, dropped[index].reason) for index in sorted(dropped)[:_MOST_LISTED]]
    listed = {f"{nm[index]:g} nm": reason for index, reason in some}
    more = {"others": len(dropped) - len(listed)} if len(dropped) > len(listed) else {}
    yield Decision(
        f"bands{where}",
        f"{len(sensor.bands.kept)} of {len(nm)} kept",
        {**listed, **more},
        f"more than half of the bands noisier than {options.max_noise:g} of their signal",
        "--drop-bands, --max-noise",
    )


def _of_mask(plan: Plan, options: ProcessOptions) -> Decision:
    backdrops = [recipe.background for recipe in plan.recipes.values()]
    found = [backdrop.in_words for backdrop in backdrops if isinstance(backdrop, Backdrop)]
    outcome = {"auto": "a backdrop that all views share is cut out", "files": "from files"}.get(
        plan.mask, plan.mask
    )
    return Decision(
        "mask",
        outcome if plan.mask != "none" else "none: all of each view is the scene",
        {"asked": options.mask, **({"backdrop": ", ".join(found)} if found else {})},
        "borders with texture, or that differ between views" if options.mask == "auto" else "",
        "--mask",
    )
