"""How long does a newcomer wait for the demo?

    python benchmarks/fresh_clone.py [--folder DIR]

Clones the repository (what is committed) into a new folder and times `make demo` there, from nothing and once more:
these two commands take a newcomer to a page of the demo that can be mailed.
From nothing: caches of pip, of kernels and of the demo scene are looked for in an empty folder, so the first run
downloads every package. Takes about six minutes and the disk space of a virtual environment.
"""

from __future__ import annotations

import json
import os
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import tyro

FIRST = _common.Limit(240.0, is_upper=True, unit=" s")
AGAIN = _common.Limit(120.0, is_upper=True, unit=" s")
OUTER_MAKE = ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES")
"""What `make bench` would otherwise hand down to the clone's own make."""
OWN_SETTINGS = ("VIRTUAL_ENV", "PYTHONPATH", "PYTHONHOME", "PIP_CACHE_DIR", "WARP_CACHE_PATH")
"""What a newcomer's shell does not set."""


@dataclass(frozen=True)
class Options:
    """Time `make demo` in a fresh clone, twice."""

    folder: Path | None = None
    """Clone into this folder, which must not exist, and keep it, to look at the pictures; None: a temporary one."""
    results: Path | None = None
    """Folder for fresh_clone.json and fresh_clone.md; None: beside the benchmarks."""
    dry_run: bool = False
    """Only show the commands."""


def main(options: Options) -> None:
    """Clone, make twice, publish."""
    machine = _machine.describe_machine()
    with ExitStack() as stack:
        temporary = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-clone-")))
        clone, caches = options.folder or temporary / "unmix-nerf", temporary / "caches"
        words = ["git", "clone", "--quiet", "--no-hardlinks", str(_common.REPOSITORY), str(clone)]
        if options.dry_run:
            print(" ".join(words), f"cd {clone}", f"XDG_CACHE_HOME={caches} make demo", "make demo", sep="\n")
            return
        _common.run_command(words)
        measured = {name: make_demo(clone, caches, name) for name in ("from nothing", "once installed")}
    setting = {"command": "make demo", "caches": "empty at first", "load averages": load_averages(measured)}
    question = "A fresh clone: seconds until the demo has trained and its pictures are written"
    report = _common.Report("fresh_clone", question, setting, machine, judge(measured), measured)
    _common.publish(report, _common.results_folder(options.results, quick=False))


def make_demo(clone: Path, caches: Path, name: str) -> dict[str, Any]:
    """Time one `make demo`, and count what it wrote."""
    load_average = _machine.load_average()
    print(f"make demo, {name} ...", flush=True)
    ended = _common.run_command(["make", "demo"], cwd=clone, env=environment(caches))
    print("\n".join(ended.output.splitlines()[-3:]), flush=True)
    run = max((clone / "outputs").glob("demo/unmix-nerf/*"), key=lambda path: path.stat().st_mtime)
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    return {
        "seconds": ended.seconds,
        "load_average_at_start": load_average,
        "page_megabytes": (run / "exports" / "page" / "page.html").stat().st_size / 1e6,
        "pictures": {part: len(list((run / part).rglob("*.png"))) for part in ("eval", "exports")},
        "metrics": {key: metrics[key] for key in ("psnr", "sam", "miou", "train_seconds")},
    }


def environment(caches: Path) -> dict[str, str]:
    """That of a newcomer's shell: other caches, nothing of an outer make or a virtual environment."""
    kept = {key: value for key, value in os.environ.items() if key not in OUTER_MAKE + OWN_SETTINGS}
    return {**kept, "XDG_CACHE_HOME": str(caches)}


def load_averages(measured: dict[str, dict[str, Any]]) -> list[float]:
    """At the start of each run."""
    return [found["load_average_at_start"] for found in measured.values()]


def judge(measured: dict[str, dict[str, Any]]) -> list[_common.Figure]:
    """Both times, and what there is to look at."""
    figures = [
        limit.judge(f"make demo, {name}", found["seconds"])
        for limit, (name, found) in zip((FIRST, AGAIN), measured.items(), strict=True)
    ]
    last = list(measured.values())[-1]
    pictures = ", ".join(f"{count} in {part}/" for part, count in last["pictures"].items())
    metrics = last["metrics"]
    return [
        *figures,
        _common.required("pictures written", "some of each", all(last["pictures"].values()), pictures),
        _common.reported("the page to share", f"{last['page_megabytes']:.1f} MB"),
        _common.reported(
            "the demo's figures",
            f"PSNR {metrics['psnr']:.1f} dB, SAM {metrics['sam']:.3f} rad, mIoU {metrics['miou']:.2f}",
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
