"""How long does a newcomer wait for the demo?

    python benchmarks/fresh_clone.py [--folder DIR]

Clones the repository (what is committed) into a new folder and times `make demo` there, from nothing and once more:
these two commands take a newcomer to a page of the demo that can be mailed. Then the same from a wheel alone, which is
installed into an empty environment: two commands as well.
From nothing: caches of pip, of kernels and of the demo scene are looked for in an empty folder, so the first run
downloads every package. Takes about six minutes and the disk space of a virtual environment.
"""

from __future__ import annotations

import json
import os
import tempfile
import venv
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
            print(
                " ".join(words),
                f"cd {clone}",
                f"XDG_CACHE_HOME={caches} make demo",
                "make demo",
                "pip install WHEEL",
                "unmix-demo",
                sep="\n",
            )
            return
        _common.run_command(words)
        commands = ("make demo, from nothing", "make demo, once installed")
        measured = {name: make_demo(clone, caches / "clone", name) for name in commands}
        measured["wheel alone, pip install and unmix-demo"] = use_wheel(
            clone, temporary / "wheel", caches / "wheel"
        )
    setting = {"caches": "empty at first", "load averages": load_averages(measured)}
    question = "A fresh clone: seconds until the demo has trained and its pictures are written"
    report = _common.Report("fresh_clone", question, setting, machine, judge(measured), measured)
    _common.publish(report, _common.results_folder(options.results, quick=False))


def make_demo(clone: Path, caches: Path, name: str) -> dict[str, Any]:
    """Time one `make demo`, and count what it wrote."""
    load_average = _machine.load_average()
    print(name, "...", flush=True)
    ended = _common.run_command(["make", "demo"], cwd=clone, env=environment(caches))
    print("\n".join(ended.output.splitlines()[-3:]), flush=True)
    return left_in(clone, ended.seconds, load_average)


def use_wheel(clone: Path, folder: Path, caches: Path) -> dict[str, Any]:
    """Time what a user without the repository types: the wheel into an empty environment, then the demo."""
    build = [
        str(clone / ".venv/bin/python"),
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(folder),
    ]
    _common.run_command([*build, str(clone)])
    [wheel] = folder.glob("*.whl")
    venv.create(folder / "environment", with_pip=True)
    programs, load_average = folder / "environment/bin", _machine.load_average()
    print("pip install, unmix-demo ...", flush=True)
    install = ["install", "--quiet", "--constraint", str(clone / "constraints.txt"), str(wheel)]
    installed = _common.run_command([str(programs / "pip"), *install], cwd=folder, env=environment(caches))
    ended = _common.run_command([str(programs / "unmix-demo")], cwd=folder, env=environment(caches))
    return {
        **left_in(folder, installed.seconds + ended.seconds, load_average),
        "install_seconds": installed.seconds,
    }


def left_in(folder: Path, seconds: float, load_average: float) -> dict[str, Any]:
    """What a demo left in a folder, and how long it took."""
    run = max((folder / "outputs").glob("demo/unmix-nerf/*"), key=lambda path: path.stat().st_mtime)
    metrics = json.loads((run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    return {
        "seconds": seconds,
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
        limit.judge(name, found["seconds"])
        for limit, (name, found) in zip((FIRST, AGAIN, FIRST), measured.items(), strict=True)
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
