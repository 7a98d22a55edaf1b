"""Do spoilt views spoil nothing: are all named, none falsely, and do the values of the others stay?

    python benchmarks/spoilt_views.py [--counts 1 3 5]

Writes the demo scene as an instrument would, thirty views, and spoils one to five of them in each of six ways: black,
overexposed, exposed otherwise than stated, blurred, with another view's pose, cut short. Each capture is processed with
its references and poses, and so is the one without the spoilt views. About 10 minutes on two quiet cores.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro
from scipy import ndimage

from unmix_plugin.captures.demo import POSES, make_demo_capture

_DARK_COUNTS, _LARGEST = 900.0, 65535.0
_MISSED = _common.Limit(0, is_upper=True)
_CHANGED = _common.Limit(0.01, is_upper=True)
_SKEW = 7
"""Views from a spoilt one to the next: neighbours in time are seldom spoilt alike."""


@dataclass(frozen=True)
class Options:
    """Spoil views of a capture and process it."""

    counts: tuple[int, ...] = (1, 3, 5)
    """Spoilt views."""
    size: int = 128
    """Width and height of each view, pixels."""
    views: int = 30
    """Of the capture."""
    only: tuple[str, ...] = ()
    """Ways to spoil a view; all if none is given."""
    folder: Path | None = None
    """Keep captures and scenes here; the sound capture is used if it is there."""
    results: Path | None = None
    """Folder for spoilt_views.json and .md; None: beside the benchmarks."""
    quick: bool = False
    """One spoilt view, 16 views of 64 pixels."""


Counts = np.ndarray
"""Of one view, float64: rows, columns, bands."""


def _scaled(factor: float) -> Callable[[Counts], Counts]:
    return lambda counts: (_DARK_COUNTS + factor * (counts - _DARK_COUNTS)).clip(0, _LARGEST)


CHANGES: dict[str, Callable[[Counts], Counts] | None] = {
    "black": _scaled(0.0),
    "overexposed": _scaled(3.5),
    "exposed otherwise": _scaled(0.4),
    "blurred": lambda counts: ndimage.gaussian_filter(counts, (3.0, 3.0, 0)),
    "another pose": None,
    "cut short": None,
}
"""By name what is done to the counts; None: not to them."""


def spoil(capture: Path, way: str, names: list[str]) -> None:
    """Spoil these views of a capture."""
    change = CHANGES[way]
    poses = json.loads((capture / POSES).read_text(encoding="utf-8"))
    by_name = {Path(frame["file_path"]).stem: frame for frame in poses["frames"]}
    every = list(by_name)
    true = {name: by_name[name]["transform_matrix"] for name in every}
    for name in names:
        path = capture / f"{name}.raw"
        if change is not None:
            _change_counts(capture / f"{name}.hdr", path, change)
        elif way == "cut short":
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        else:
            other = every[(every.index(name) + len(every) // 2) % len(every)]
            by_name[name]["transform_matrix"] = true[other]
    (capture / POSES).write_text(json.dumps(poses), encoding="utf-8")


def _change_counts(header: Path, path: Path, change: Callable[[Counts], Counts]) -> None:
    text = header.read_text(encoding="utf-8").lower()
    rows, columns, bands = (
        int(re.findall(rf"^{key}\s*=\s*(\d+)", text, re.M)[0]) for key in ("lines", "samples", "bands")
    )
    interleave = re.findall(r"^interleave\s*=\s*(\w+)", text, re.M)[0]
    shape, axes = {
        "bip": ((rows, columns, bands), (0, 1, 2)),
        "bil": ((rows, bands, columns), (0, 2, 1)),
        "bsq": ((bands, rows, columns), (1, 2, 0)),
    }[interleave]
    stored = np.fromfile(path, np.uint16).reshape(shape)
    changed = change(stored.transpose(axes).astype(np.float64))
    changed.round().astype(np.uint16).transpose(np.argsort(axes)).tofile(path)


def process(capture: Path, scene: Path) -> dict[str, Any]:
    """transforms.json of the scene made of a capture."""
    words = ["cubes", "--data", str(capture), "--output-dir", str(scene), "--poses", str(capture / POSES)]
    words += ["--white", str(capture / "white.hdr"), "--dark", str(capture / "dark.hdr"), "--mask", "none"]
    _common.run_command([_common.console_script("unmix-process"), *words])
    return json.loads((scene / "transforms.json").read_text(encoding="utf-8"))


def values(scene: Path, content: dict[str, Any]) -> dict[str, np.ndarray]:
    """What was measured in each view, by its name, in the unit of the references."""
    scale = content["calibrated_value_of_1"] / content["value_scale"]
    return {
        Path(frame["file_path"]).stem: np.load(scene / frame["hyperspectral_file_path"]).astype(float) * scale
        for frame in content["frames"]
    }


def compare(kept: dict[str, np.ndarray], base: dict[str, np.ndarray]) -> float:
    """Largest over views of the mean difference, as a share of what the view shows."""
    common = kept.keys() & base.keys()
    bands = {(kept[name].shape, base[name].shape) for name in common}
    if not common or any(one != other for one, other in bands):
        return float("inf")
    return max(float(np.abs(kept[name] - base[name]).mean() / base[name].mean()) for name in common)


def main(options: Options) -> None:
    """Measure and publish."""
    if options.quick:
        options = replace(options, counts=(1,), size=64, views=16)
    rows: list[dict[str, Any]] = []
    with ExitStack() as stack:
        folder = options.folder or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-spoilt-"))
        )
        sound = folder / "sound"
        if not sound.is_dir():
            make_demo_capture(sound, options.size, views=options.views)
        base_scene = folder / "sound-scene"
        shutil.rmtree(base_scene, ignore_errors=True)
        base = process(sound, base_scene)
        rows.append(_row("none", [], base, 0.0))
        known = values(base_scene, base)
        for way in options.only or tuple(CHANGES):
            for count in options.counts:
                names = [f"view_{(3 + _SKEW * index) % options.views:03d}" for index in range(count)]
                capture, scene = folder / "capture", folder / "scene"
                for path in (capture, scene):
                    shutil.rmtree(path, ignore_errors=True)
                shutil.copytree(sound, capture)
                spoil(capture, way, names)
                found = process(capture, scene)
                rows.append(_row(way, names, found, compare(values(scene, found), known)))
                print(json.dumps(rows[-1]), flush=True)
    publish(options, rows)


def _row(way: str, spoilt: list[str], content: dict[str, Any], changed: float) -> dict[str, Any]:
    named = {view["name"]: view["reason"] for view in content.get("left_out", [])}
    return {
        "way": way,
        "spoilt": len(spoilt),
        "missed": len(set(spoilt) - named.keys()),
        "false": len(named.keys() - set(spoilt)),
        "reasons": ", ".join(sorted(set(named.values()))),
        "values changed": round(changed, 5),
    }


def publish(options: Options, rows: list[dict[str, Any]]) -> None:
    """Figures over all captures, and a row each."""
    figures = [
        _MISSED.judge("spoilt views that are not named", sum(row["missed"] for row in rows)),
        _MISSED.judge("sound views that are named", sum(row["false"] for row in rows)),
        _CHANGED.judge("values of the others, most changed", max(row["values changed"] for row in rows)),
    ]
    table = _common.DetailTable("captures", list(rows[0]), [list(map(str, row.values())) for row in rows])
    setting = {"counts": list(options.counts), "size": options.size, "views": options.views}
    report = _common.Report(
        "spoilt_views",
        "Captures of which some views are spoilt, against the one without",
        setting,
        _machine.describe_machine("cpu"),
        figures,
        {"captures": rows},
        (table,),
    )
    _common.publish(report, _common.results_folder(options.results, options.quick))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
