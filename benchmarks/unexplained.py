"""Is what no material explains found: planted patches of a material that is not among the endmembers?

    python benchmarks/unexplained.py [--scenes 10 --steps 600]

Renders tables of objects whose materials are drawn, with a flat patch of 0.5 to 3 % of the surface on each: of a
material that is nowhere else, in every other scene a metamer of what it lies on (the same chromaticity, 0.7 times as
bright, another spectrum).
Each is trained with as many endmembers as there are other materials. A patch is found where the run names one whose
middle is within a patch's radius, and a pixel, of the true one; all others are false. Each scene is trained without its
patch as well, where nothing is to be named. About 15 minutes on two quiet cores.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import _common
import _machine
import numpy as np
import tyro
from scipy import linalg

from unmix_plugin.scenes.demo import scene as demo
from unmix_plugin.scenes.demo.shading import (
    MATERIALS,
    THINGS,
    Surface,
    Thing,
    lamp_power,
    plain,
    reflectances,
)
from unmix_plugin.scenes.demo.shapes import PlacedPrimitive
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix

_FOUND = _common.Limit(0.9)
_FALSE = _common.Limit(1, is_upper=True)
_SURFACE = 11.5
"""Of the table and what stands on it, square units of the demo scene."""
_TOP = 0.001
"""Height of the table's top."""


@dataclass(frozen=True)
class Options:
    """Plant patches and look for them."""

    scenes: int = 10
    """How many are drawn."""
    steps: int = 600
    """Of each training."""
    size: int = 72
    """Width and height of every view, pixels."""
    bands: int = 21
    """Of every view."""
    folder: Path | None = None
    """Keep scenes and runs here; what is there is used."""
    results: Path | None = None
    """Folder for unexplained.json and unexplained.md; None: beside the benchmarks."""
    quick: bool = False
    """One scene, 40 steps."""


@dataclass(frozen=True)
class Planted:
    """A patch on the table of a drawn scene."""

    things: tuple[Thing, ...]
    """Of all materials but the last of `MATERIALS`, without the patch."""
    is_metamer: bool
    """Whether it looks like the table's first material."""
    surface: float
    """Part of the surface that it covers."""
    middle: tuple[float, float, float]
    radius: float

    @property
    def thing(self) -> Thing:
        """The patch itself."""
        hidden = MATERIALS[-1]
        lens = PlacedPrimitive("cylinder", (*self.middle[:2], 0.0), (self.radius, self.radius, _TOP))
        return Thing(lens, Surface(hidden, hidden, plain))


def draw(seed: int) -> Planted:
    """A scene by its number."""
    generator = np.random.default_rng(100 + seed)
    known = MATERIALS[:-1]
    things, is_metamer = [], seed % 2 == 1
    for number, thing in enumerate(THINGS):
        first, second = generator.choice(known, 2, replace=False)
        if is_metamer and number == 0:  # a dark colour has no room for metamers that differ
            first, second = "white", second if second != "white" else first
        things.append(replace(thing, surface=replace(thing.surface, first=str(first), second=str(second))))
    surface = float(np.linspace(0.005, 0.03, 10)[seed % 10])
    radius = float(np.sqrt(surface * _SURFACE / np.pi))
    angle = generator.uniform(-0.7, 0.1)
    away = 1.2 - radius  # between the objects and the rim
    middle = (away * np.cos(angle), away * np.sin(angle), _TOP)
    return Planted(tuple(things), is_metamer, surface, middle, radius)


def spectra_with(planted: Planted, wavelengths_nm: np.ndarray) -> np.ndarray:
    """Reflectances of all materials (K, B); the last is the patch's, of a metamer that of what it lies on plus what no
    eye sees under the lamp."""
    spectra = reflectances(wavelengths_nm)
    if planted.is_metamer:
        bands, base = (
            Bands.of(wavelengths_nm),
            0.7 * spectra[MATERIALS.index(planted.things[0].surface.first)],
        )
        seen = rgb_matrix(bands).double().numpy() * lamp_power(wavelengths_nm)[:, None]
        unseen = linalg.null_space(seen.T)
        black = unseen @ (unseen.T @ np.sin(np.linspace(0.0, 5 * np.pi, len(base))))
        room = np.where(black > 0, 0.98 - base, base - 0.01) / np.maximum(np.abs(black), 1e-9)
        spectra[-1] = base + black * min(float(room.min()), 0.25)
    return spectra


def train(planted: Planted, has_patch: bool, folder: Path, options: Options) -> dict[str, Any]:
    """What the run of a scene says is unexplained."""
    data = folder / "scene"
    if not data.is_dir():
        things = (*planted.things, *([planted.thing] if has_patch else []))
        with patch.object(demo, "reflectances", lambda nm: spectra_with(planted, nm)):
            demo.make_demo_scene(
                data, options.size, options.bands, 32, place=demo.Place(things, demo.demo_cameras)
            )
    found = sorted(folder.glob("runs/scene/unmix-nerf/*/unexplained.json"))
    if not found:
        words = ["unmix-nerf", "--data", str(data), "--device", "cpu", "--output-dir", str(folder / "runs")]
        words += ["--max-num-iterations", str(options.steps), "--endmembers", str(_num_known(planted))]
        run = _common.run_command([_common.console_script("unmix-train"), *words]).run
        found = [run / "unexplained.json"]
    return json.loads(found[-1].read_text(encoding="utf-8"))


def _num_known(planted: Planted) -> int:
    """Materials that are to be seen beside the patch."""
    surfaces = [thing.surface for thing in planted.things]
    return len({one.first for one in surfaces} | {one.second for one in surfaces if one.blend is not plain})


def main(options: Options) -> None:
    """Plant, train, and publish what is found."""
    if options.quick:
        options = replace(options, scenes=1, steps=40)
    rows = []
    with ExitStack() as stack:
        place = options.folder or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-unexplained-"))
        )
        for number in range(options.scenes):
            planted = draw(number)
            named = train(planted, True, place / f"{number}-patch", options)["patches"]
            without = train(planted, False, place / f"{number}-none", options)["patches"]
            reach = planted.radius + 4.0 / options.size
            near = [
                bool(np.linalg.norm(np.subtract(one["position"], planted.middle)) <= reach) for one in named
            ]
            rows.append(
                {
                    "scene": number,
                    "metamer": planted.is_metamer,
                    "surface": planted.surface,
                    "found": any(near),
                    "surface found": sum(
                        one["surface"] for one, is_it in zip(named, near, strict=True) if is_it
                    ),
                    "part": max(
                        (one["part"] for one, is_it in zip(named, near, strict=True) if is_it), default=0.0
                    ),
                    "false": near.count(False) + len(without),
                }
            )
            print(json.dumps(rows[-1]), flush=True)
    figures = [
        _FOUND.judge("planted patches found", float(np.mean([row["found"] for row in rows]))),
        _FALSE.judge("patches named that are none", sum(row["false"] for row in rows)),
    ]
    table = _common.DetailTable(
        "scenes", list(rows[0]), [[f"{value:.3g}" for value in row.values()] for row in rows]
    )
    setting = {name: getattr(options, name) for name in ("scenes", "steps", "size", "bands")}
    question = "Patches of a material that is not among the endmembers, and scenes without one"
    machine = _machine.describe_machine("cpu")
    report = _common.Report("unexplained", question, setting, machine, figures, {"scenes": rows}, (table,))
    _common.publish(report, _common.results_folder(options.results, options.quick))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
