"""Are the true materials found, by methods that see single pixels and by a field over many views?

    python benchmarks/unmixing.py [--rows 2d] [--rows 3d:ours 3d:published] [--seeds 0 1 2 3 4]

Each row is a method; of every scene and seed it reports segmentation, abundances and endmembers beside how well spectra
are met. Nothing but the rows called oracle uses labels or true spectra; the number of endmembers is the true one.
Rows `2d:...` explain the true pixels of the evaluation views with endmembers found in the training views, so that their
PSNR and spectral angle say how well a pixel is fitted; with them the number of materials is proposed too. Rows
`3d:...` train, then predict the evaluation views, by the commands that a user would give. They train as long as the
defaults say, which is 7 to 15 minutes a scene and seed and gives the same figures on any machine; with `--max-seconds
90` they are broken off, all rows at the same time, and what is written is called unmixing-90s. Without `--rows`: all
2-D methods, the defaults and the method as published. Rows and seeds measured earlier, 3-D ones with the same words,
stay in the table; so do not mix versions of the code whose figures differ.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import _common
import _machine
import tyro
from _unmixing_3d import TRAINED_ROWS, train_and_score
from _unmixing_report import OURS, SceneFigures, Seeds, judge, tables


@dataclass(frozen=True)
class Options:
    """Unmix each scene by each method."""

    scenes: Path | None = None
    """Folder of scene folders; each needs labels and true spectra. None: those of scenes.py."""
    only: tuple[str, ...] = ()
    """Names of the scenes; all if none is given."""
    rows: tuple[str, ...] = ("2d", OURS, "3d:published")
    """Rows to measure: names, or 2d and 3d for all of a kind."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """One run each."""
    max_seconds: float | None = None
    """Seconds of training, a scene and seed; None: as many steps as the defaults take."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train."""
    runs: Path | None = None
    """Keep the run folders here."""
    results: Path | None = None
    """Folder for what is written, unmixing.json and unmixing.md or unmixing-90s.json and .md; None: beside the
    benchmarks."""
    quick: bool = False
    """One seed, two 2-D rows, three seconds of training."""


def main(options: Options) -> None:
    """Measure every row of every scene and publish."""
    names = chosen_rows(("2d:k-means, NNLS", "2d:oracle, NNLS", OURS) if options.quick else options.rows)
    seeds = options.seeds[:1] if options.quick else options.seeds
    seconds = 3.0 if options.quick else options.max_seconds
    folders = _common.scene_folders(options.scenes, options.only)
    machine = _machine.describe_machine(options.device)
    setting = {
        "options": "defaults, but the seed, --pipeline.model.num-endmembers and the words of each 3-D row",
        "max_seconds": seconds,
        "device": options.device,
    } | {name: " ".join(words) or "no words" for name, words in TRAINED_ROWS.items()}
    results = _common.results_folder(options.results, options.quick)
    measured = earlier(results, setting)
    with ExitStack() as stack:
        runs = options.runs or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-unmixing-"))
        )
        for folder in folders:
            found = measured.setdefault(folder.name, SceneFigures())
            measure_pixels(folder, [name for name in names if name.startswith("2d:")], seeds, found)
            for name in (name for name in names if name.startswith("3d:")):
                scores = {
                    str(seed): train_and_score(folder, name, seed, seconds, options.device, runs)
                    for seed in seeds
                }
                found.rows[name] = found.rows.get(name, {}) | scores
    publish(measured, setting, machine, results)


def publish(
    measured: dict[str, SceneFigures],
    setting: dict[str, Any],
    machine: dict[str, Any],
    results: Path | None,
) -> None:
    """Print and write the judged figures, means over scenes, and a table a scene."""
    seconds = setting["max_seconds"]
    order = {name: index for index, name in enumerate(every_row())}
    measured = {
        scene: SceneFigures(
            {name: found.rows[name] for name in sorted(found.rows, key=order.__getitem__)}, found.proposed
        )
        for scene, found in sorted(measured.items())
    }
    training = "to the end" if seconds is None else f"for {seconds:g} s"
    report = _common.Report(
        "unmixing",
        "Materials found by methods that see single pixels (2d) and by a field over many views (3d), trained "
        f"{training}: medians over seeds, with the standard deviation of mIoU and the number of seeds",
        setting,
        machine,
        judge(measured),
        {scene: asdict(found) for scene, found in measured.items()},
        tables(measured),
        _common.seconds_variant(seconds),
    )
    _common.publish(report, results)


def every_row() -> list[str]:
    """Names of all rows that can be measured."""
    from _unmixing_methods import METHODS

    return [*(f"2d:{name}" for name in METHODS), *TRAINED_ROWS]


def chosen_rows(asked: tuple[str, ...]) -> list[str]:
    """Rows of these names or kinds.

    Raises:
        SystemExit: an unknown one.
    """
    known = every_row()
    unknown = [word for word in asked if word not in known and word not in ("2d", "3d")]
    if unknown:
        raise SystemExit(f"no row is called {unknown[0]!r}; take 2d, 3d or any of: {'; '.join(known)}")
    return [name for name in known if name in asked or name[:2] in asked]


def measure_pixels(folder: Path, names: list[str], seeds: tuple[int, ...], found: SceneFigures) -> None:
    """Add the figures of 2-D rows, and the proposed number of materials."""
    if not names:
        return
    from _unmixing_2d import PixelBaselines
    from _unmixing_methods import METHODS

    from unmix_plugin.scenes.reading.loader import load_scene
    from unmix_plugin.settings import SceneOptions
    from unmix_plugin.trained.evaluation import finite_or_none

    baselines = PixelBaselines(load_scene(folder, SceneOptions()))
    if baselines.truth.endmembers is None:
        raise SystemExit(f"{folder.name} has no true spectra to compare with; leave it out with --only")
    for name in names:
        print(f"{folder.name}: {name} ...", flush=True)
        method = METHODS[name.removeprefix("2d:")]
        runs: Seeds = {}
        for seed in seeds[:1] if method.is_oracle else seeds:
            runs[str(seed)] = finite_or_none(baselines.score(method, seed))
        found.rows[name] = runs
    found.proposed = {str(seed): baselines.propose(seed) for seed in seeds}


def earlier(results: Path | None, setting: dict[str, Any]) -> dict[str, SceneFigures]:
    """What was measured before, by scene: 2-D rows, which no setting touches, and 3-D rows of the same words."""
    name = _common.results_name("unmixing", _common.seconds_variant(setting["max_seconds"]))
    path = None if results is None else results / f"{name}.json"
    if path is None or not path.is_file():
        return {}
    report = json.loads(path.read_text(encoding="utf-8"))
    before = report["setting"]
    is_same = all(before.get(key) == setting[key] for key in ("max_seconds", "device"))
    kept = [
        name
        for name in every_row()
        if name.startswith("2d:") or (is_same and before.get(name) == setting[name])
    ]
    return {
        scene: SceneFigures(
            {name: seeds for name, seeds in found["rows"].items() if name in kept}, found["proposed"]
        )
        for scene, found in report["measured"].items()
    }


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
