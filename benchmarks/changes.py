"""Is what changed on an object found, and nothing else?

    python benchmarks/changes.py [--steps 2000] [--runs FOLDER]

Makes the demo scene before and after one planted change, as other cameras see it in 20 % more light and in another
world: abundance +0.2 on 5 % of the surface; a stain of another material on 2 %; a dent of 1 % of the size; none. Trains
on each for a short time, compares, and asks how well the captures are laid on each other, how much of the changed area
is found, how much of the rest is said to have changed, and how often a nominal p is undercut where nothing changed.
Takes about fifteen minutes on two cores.
"""

from __future__ import annotations

import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro
from _changed_scenes import CHANGES, Planted, other_world, write_capture

from unmix_plugin.comparing.comparison import TESTED, Comparison, compare_runs
from unmix_plugin.comparing.registration import Similarity

REGISTRATION = _common.Limit(0.5, is_upper=True, unit=" px")
FOUND, FALSE = _common.Limit(95.0, unit=" %"), _common.Limit(1.0, is_upper=True, unit=" %")
ALARMS, SECONDS = (
    _common.Limit(1.0, is_upper=True, unit=" points"),
    _common.Limit(180.0, is_upper=True, unit=" s"),
)
NOMINAL = 0.05


@dataclass(frozen=True)
class Options:
    """Compare pairs of captures with a planted change."""

    steps: int = 2000
    """Of each training: figures are those of any machine."""
    size: int = 96
    bands: int = 31
    views: int = 32
    runs: Path | None = None
    """Folder to keep scenes and runs in and to take them from; None: a temporary one."""
    results: Path | None = None
    """Folder for changes.json and changes.md; None: beside the benchmarks."""
    quick: bool = False
    """Small scenes and a few steps of training."""


def main(options: Options) -> None:
    """Write, train, compare, publish."""
    if options.quick:
        options = Options(150, 48, 8, 16, options.runs, options.results, True)
    with ExitStack() as stack:
        folder = options.runs or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-changes-"))
        )
        before = trained(folder, "before", None, options)
        measured = {}
        for change in CHANGES:
            after = trained(folder, change.name, change, options)
            pair = (after, before) if change.bump > 0 else (before, after)
            started = time.monotonic()
            found = compare_runs(*pair)
            seconds = time.monotonic() - started
            measured[change.name] = {"seconds": seconds, **judged(found, change)}
            print(change.name, measured[change.name], flush=True)
    report = _common.Report(
        name="changes",
        question="Is what changed on an object found, and nothing else?",
        setting={
            "scene": f"{options.size} x {options.size} pixels, {options.bands} bands, {options.views} views",
            "steps": options.steps,
        },
        machine=_machine.describe_machine(),
        figures=figures(measured),
        measured=measured,
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


def trained(folder: Path, name: str, change: Planted | None, options: Options) -> Path:
    """The run of a capture, made where it is not there yet."""
    scene, outputs = folder / "scenes" / name, folder / "runs" / name
    kept = sorted(path.parent for path in outputs.glob("*/unmix-nerf/*/config.json"))
    if kept:
        return kept[-1]
    if not (scene / "transforms.json").is_file():
        write_capture(scene, change, options.size, options.bands, options.views)
    words = ["--data", str(scene), "--output-dir", str(outputs)]
    words += ["--max-num-iterations", str(options.steps)]
    return _common.run_command([_common.console_script("unmix-train"), "unmix-nerf", *words]).run


def judged(found: Comparison, change: Planted) -> dict[str, Any]:
    """What is right and what is wrong, by the truth."""
    surface, pixel = found.surface, found.before.pixel
    to_other = Similarity(*other_world())
    is_reversed = change.bump > 0
    true = to_other if is_reversed else to_other.inverse
    elsewhere = found.registration.to_before.inverse.apply(surface.positions)
    off = np.linalg.norm(true.apply(elsewhere) - surface.positions, axis=1) / pixel
    first = to_other.inverse if is_reversed else Similarity.identity()
    positions, up = first.apply(surface.positions), first.turn(surface.normals)[:, 2]
    planted = np.zeros(len(positions), bool)
    if change.region is not None:
        planted = change.region.has(positions) & (up > -0.5)
    areas, known = surface.areas, found.known

    def part(chosen: np.ndarray, of: np.ndarray) -> float | None:
        return float(areas[chosen & of].sum() / areas[of].sum()) if of.any() else None

    return {
        "registration_rms_px": float(np.sqrt((off**2).mean())),
        "own_rms_px": found.registration.rms_px,
        "overlap": found.registration.overlap,
        "planted_part": part(planted, np.ones_like(planted)),
        "compared_part": part(known, np.ones_like(planted)),
        "found": part(found.changed, planted & known),
        "false": part(found.changed, ~planted & known),
        "alarms": {
            name: part(np.nan_to_num(one.p, nan=1.0) <= NOMINAL, ~planted & np.isfinite(one.p))
            for name, one in found.differences.items()
        },
        "places": [[place.what, place.area, place.p, place.in_words()] for place in found.places],
    }


def figures(measured: dict[str, dict[str, Any]]) -> list[_common.Figure]:
    """The table."""
    lines = []
    for name, one in measured.items():
        lines.append(REGISTRATION.judge(f"{name}: registration, rms", one["registration_rms_px"]))
        if one["found"] is not None:
            share = one["planted_part"]
            lines.append(FOUND.judge(f"{name}: found of the changed area ({share:.1%})", 100 * one["found"]))
        lines.append(FALSE.judge(f"{name}: of the rest said to have changed", 100 * one["false"]))
        lines.append(SECONDS.judge(f"{name}: comparison", one["seconds"]))
    for quantity in TESTED:
        off = 100 * abs(measured["none"]["alarms"][quantity] - NOMINAL)
        lines.append(ALARMS.judge(f"none: false alarms of {quantity} off the nominal {NOMINAL:.0%}", off))
    abundances = [value for name, value in measured["none"]["alarms"].items() if name.startswith("abundance")]
    shown = ", ".join(f"{value:.1%}" for value in abundances)
    lines.append(_common.reported(f"none: the same of each abundance at {NOMINAL:.0%}", shown))
    return lines


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
