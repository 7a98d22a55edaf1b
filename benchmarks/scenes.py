"""Make the scenes that benchmarks train on: path-traced with Mitsuba 3, with true materials.

    python benchmarks/scenes.py [OUT] [--only table room]

They are written into a cache that all benchmarks look in (or into OUT), each once; what is there is kept. Needs the
extra `reference` (pip install '.[reference]') and about 30 minutes of two cores. Seeds are fixed. Nobody chooses
settings by looking at the scenes called `unseen`: they are drawn by a seed.
"""

from __future__ import annotations

import importlib.util
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import _common
import tyro


@dataclass(frozen=True)
class Options:
    """Render the scenes of the benchmarks."""

    out: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of scene folders; None: the cache."""
    only: tuple[str, ...] = ()
    """Names of scenes to render; all if none is given."""
    quick: bool = False
    """Four paths per pixel, to see that it works."""


def main(options: Options) -> None:
    """Render what is missing."""
    if importlib.util.find_spec("mitsuba") is None:
        raise SystemExit("Mitsuba, which renders the scenes, is not installed: pip install '.[reference]'")
    from dataclasses import replace

    from _path_tracing import write_scene
    from _traced_scenes import describe, scene_names

    out = options.out or _common.scenes_folder()
    unknown = set(options.only) - set(scene_names())
    if unknown:
        raise SystemExit(f"no scenes: {', '.join(sorted(unknown))}; there are {', '.join(scene_names())}")
    names = options.only or scene_names()
    started = time.monotonic()
    for number, name in enumerate(names, start=1):
        if _common.is_made(out / name):
            print(f"{name} ({number} of {len(names)}): is there", flush=True)
            continue
        scene = describe(name)
        if options.quick:
            scene = replace(scene, paths=4)
        building = out / f"{name}.building"
        shutil.rmtree(building, ignore_errors=True)

        def follow(share: float, title: str = f"{name} ({number} of {len(names)})") -> None:
            print(f"{title}: {share:.0%}, {time.monotonic() - started:.0f} s so far", flush=True)

        write_scene(scene, building, follow)
        (building / _common.MADE).touch()
        building.rename(out / name)
        print(f"{name}: {scene.like}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
