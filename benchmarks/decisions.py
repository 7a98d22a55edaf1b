"""Are automatic decisions right on small scenes of which the truth is known?

    python benchmarks/decisions.py [--train-steps 200 --train-each 4]

Renders closed rooms with plain walls, things before skies, walls and corners, open places, tables with alpha, exposures
that are equal and not, true poses and poses in other conventions, and floors with patterns that repeat. Asks what
`unmix-train --explain` decides of each and, of the floors, whether unmix-process calls true poses wrong. Nothing is
trained, unless `--train-steps` asks what a decision about the backdrop costs against `--world bounded` and `unbounded`.
About 8 minutes on two quiet cores, with the trainings of these options 25.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import _common
import _machine
import numpy as np
import tyro
from PIL import Image
from scipy import ndimage

from unmix_plugin.captures.match_checks import MatchedScene, check_matches
from unmix_plugin.captures.poses.lens import Lens
from unmix_plugin.captures.poses.pose_set import PosedCamera
from unmix_plugin.captures.report import Code
from unmix_plugin.commands.train import parse
from unmix_plugin.engine.decisions import UNDECIDED
from unmix_plugin.engine.geometry.camera_paths import upright_cameras
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.training.steps import prepare_steps
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.demo.scene import PLACES, Place, demo_cameras, make_demo_scene
from unmix_plugin.scenes.demo.shading import MATERIALS, THINGS, Surface, Thing, plain
from unmix_plugin.scenes.demo.shapes import PlacedPrimitive

_BANDS, _FLOOR, _CEILING = 8, -0.12, 5.0
Triple = tuple[float, float, float]
Truth = dict[str, str | tuple[str, ...]]
"""What is true, by subject of a decision; an outcome that starts so, or with one of these, is right."""
_REFUSED = "refused"
_FITS: Truth = {"poses": "fit"}
_UNDECIDED_LIMIT = _common.Limit(3, is_upper=True)
_WRONG_LIMIT = _common.Limit(0, is_upper=True)


@dataclass(frozen=True)
class Options:
    """Judge decisions."""

    size: int = 64
    """Width and height of every view, pixels."""
    views: int = 24
    """Views of each scene."""
    seed: int | None = None
    """Judge rooms, skies, walls and corners that are drawn with this seed instead: nothing was tuned on them."""
    train_steps: int | None = None
    """Train rooms and things before backdrops so long with what is decided, bounded and unbounded; None trains
    nothing."""
    train_each: int = 1
    """Of those that are trained, each so many-th."""
    folder: Path | None = None
    """Keep scenes and runs here; scenes that are there are used."""
    results: Path | None = None
    """Folder for decisions.json and decisions.md; None: beside the benchmarks."""
    quick: bool = False
    """A tenth of the scenes, 16 views of 48 pixels."""


@dataclass(frozen=True)
class Case:
    """A scene and what is true of it."""

    name: str
    kind: str
    place: Place
    truth: Truth
    change: Callable[[Path], None] | None = None
    """Of the written scene."""
    can_train: bool = False


def _slab(center: Triple, half: Triple, material: str, turn_deg: float = 0.0) -> Thing:
    placement = PlacedPrimitive("box", center, half, turn_deg=turn_deg)
    return Thing(placement, Surface(material, material, plain))


def _room(reach: float, flat: str, left: str, right: str, ends: str) -> list[Thing]:
    middle, half = 0.5 * (_CEILING + _FLOOR), 0.5 * (_CEILING - _FLOOR)
    wide, away = reach + 0.2, reach + 0.1
    return [
        _slab((0, 0, _FLOOR - 0.1), (wide, wide, 0.1), flat),
        _slab((0, 0, _CEILING + 0.1), (wide, wide, 0.1), flat),
        _slab((-away, 0, middle), (0.1, reach, half), left),
        _slab((away, 0, middle), (0.1, reach, half), right),
        _slab((0, away, middle), (reach, 0.1, half), ends),
        _slab((0, -away, middle), (reach, 0.1, half), ends),
    ]


def _corner(away: float, floor: str, left: str, right: str) -> list[Thing]:
    things, half = [_slab((0, 0, _FLOOR - 0.1), (12, 12, 0.1), floor)], (away + 6.2) / 2
    for side, material in ((-1, left), (1, right)):
        across, along = np.array([side, 1]) / np.sqrt(2), np.array([-side, 1]) / np.sqrt(2)
        x, y = across * (away + 0.1) + along * (away - 5.8) / 2
        turn_deg = float(np.degrees(np.arctan2(across[1], across[0])))
        things.append(_slab((float(x), float(y), 3 + _FLOOR), (0.1, half, 3), material, turn_deg))
    return things


def _wall(away: float, floor: str, material: str) -> list[Thing]:
    return [
        _slab((0, 0, _FLOOR - 0.1), (12, 12, 0.1), floor),
        _slab((0, away + 0.1, 3), (12, 0.1, 3.2), material),
    ]


def _sky(material: str, level: float) -> Callable[[np.ndarray], np.ndarray]:
    power = level * (np.array(MATERIALS) == material).astype(np.float32)
    return lambda directions: np.tile(power, (len(directions), 1))


def _looking(places: np.ndarray, targets: np.ndarray, size: int, angle_deg: float) -> Cameras:
    backward = places - targets
    backward /= np.linalg.norm(backward, axis=1, keepdims=True)
    return upright_cameras(places, backward, size, np.deg2rad(angle_deg))


def _ring(size: int, views: int) -> Cameras:
    turns = np.arange(views) * 2 * np.pi / views
    places = np.stack([2.9 * np.cos(turns), 2.9 * np.sin(turns), 1 + 0.4 * np.sin(3 * turns)], axis=1)
    return _looking(places, np.array([0, 0, 0.3]), size, 60.0)


def _wide_dome(size: int, views: int) -> Cameras:
    return demo_cameras(size, views, 60.0)


def _from_one_side(size: int, views: int) -> Cameras:
    generator = np.random.default_rng(3)
    places = np.array([0, -2.6, 1.4]) + generator.uniform(-1, 1, (views, 3)) * (0.9, 0.2, 0.7)
    targets = np.array([0, 0.3, 0.8]) + generator.uniform(-0.2, 0.2, (views, 3))
    return _looking(places, targets, size, 60.0)


def _before_a_wall(size: int, views: int) -> Cameras:
    generator = np.random.default_rng(5)
    azimuth = np.deg2rad(-90 + generator.uniform(-40, 40, views))
    height = np.deg2rad(generator.uniform(12, 40, views))
    flat = np.cos(height)
    away = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)], axis=1)
    middle = np.array([0, 0, 0.22])
    return _looking(middle + 4.1 * away, middle, size, 40.0)


def _with_other_poses(convention: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        content = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            if "OpenCV" in convention:
                matrix = matrix @ np.diag([1.0, -1.0, -1.0, 1.0])
            if convention.startswith("world to camera"):
                matrix = np.linalg.inv(matrix)
            frame["transform_matrix"] = matrix.tolist()
        (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")

    return change


def _with_unequal_exposures(folder: Path) -> None:
    generator = np.random.default_rng(2)
    for path in sorted((folder / "cubes").glob("*.npy")):
        np.save(path, (np.load(path) * generator.uniform(0.45, 1.0)).astype(np.float16))


def cases() -> Iterator[Case]:
    """All scenes."""
    dark = _sky("white", 0.0)
    no_backdrop: Truth = {**_FITS, "backdrop": "none"}
    walls = {
        "white": ("white",) * 4,
        "cyan": ("cyan",) * 4,
        "red walls": ("white", "red", "red", "red"),
        "green and yellow": ("yellow", "green", "green", "green"),
        "coloured sides": ("white", "red", "green", "white"),
        "four colours": ("white", "red", "cyan", "yellow"),
    }
    around = {
        "ring": (3.6, _ring),
        "dome": (4.4, demo_cameras),
        "wide dome": (4.6, _wide_dome),
        "one side": (3.0, _from_one_side),
    }
    for wall, materials in walls.items():
        for where, (reach, cameras) in around.items():
            place = Place((*THINGS, *_room(reach, *materials)), cameras, dark)
            yield Case(f"room, {wall}, {where}", "rooms", place, no_backdrop, can_train=True)
    found: Truth = {**_FITS, "backdrop": "found"}
    for material, level in (("white", 0.0), ("white", 0.2), ("white", 0.9), ("cyan", 0.6), ("red", 0.7)):
        for where, cameras in (("dome", demo_cameras), ("ring", _ring)):
            place = Place(THINGS, cameras, _sky(material, level))
            yield Case(f"before {material} {level:g}, {where}", "backdrops", place, found, can_train=True)
    # At a finite distance: a part of the scene that is learnt like all others.
    standing = {
        "a grey corner": _corner(1.6, "white", "white", "white"),
        "a far grey corner": _corner(3.5, "white", "white", "white"),
        "a cyan corner": _corner(1.6, "white", "cyan", "cyan"),
        "a corner of three colours": _corner(1.6, "white", "cyan", "red"),
        "a white wall": _wall(2.0, "white", "white"),
        "a red wall": _wall(2.0, "white", "red"),
        "a far wall": _wall(6.0, "cyan", "purple"),
    }
    for name, things in standing.items():
        place = Place((*THINGS, *things), _before_a_wall, dark)
        yield Case(f"before {name}", "walls and corners", place, no_backdrop, can_train=True)
    for name in ("world", "room"):
        yield Case(f"open {name}", "open places", PLACES[name], {**no_backdrop, "world": "unbounded"})
    table, before = PLACES["table"], Place(THINGS, demo_cameras, _sky("white", 0.2))
    yield Case("table with alpha", "exposures", table, {**_FITS, "light": "fixed"})
    yield Case("exposures, alpha", "exposures", table, {"light": "per-view"}, _with_unequal_exposures)
    yield Case(
        "exposures, open", "exposures", PLACES["world"], {"light": "per-view"}, _with_unequal_exposures
    )
    for place_name, place in (("alpha", table), ("backdrop", before), ("world", PLACES["world"])):
        for convention in (
            "camera to world, OpenCV axes",
            "world to camera, OpenGL axes",
            "world to camera, OpenCV axes",
        ):
            truth: Truth = {"poses": (f"look like {convention}", _REFUSED)}  # masks contradict the poses
            name = f"poses {convention}, {place_name}"
            yield Case(name, "wrong conventions", place, truth, _with_other_poses(convention))


@dataclass(frozen=True)
class _DrawnCameras:
    """Random cameras of one kind, the same at each call."""

    kind: Literal["ring", "dome", "one side", "before a wall"]
    seed: int
    away: float
    angle_deg: float

    def __call__(self, size: int, views: int) -> Cameras:
        generator = np.random.default_rng(self.seed)
        if self.kind == "dome":
            return demo_cameras(size, views, self.angle_deg)
        if self.kind == "one side":
            places = np.array([0, -self.away, 1.4]) + generator.uniform(-1, 1, (views, 3)) * (0.9, 0.2, 0.7)
            targets = np.array([0, 0.3, 0.6]) + generator.uniform(-0.2, 0.2, (views, 3))
            return _looking(places, targets, size, self.angle_deg)
        if self.kind == "ring":
            turns = generator.uniform(0, 6) + np.arange(views) * 2 * np.pi / views
            height = 1 + generator.uniform(0.1, 0.6) * np.sin(3 * turns)
            places = np.stack([self.away * np.cos(turns), self.away * np.sin(turns), height], axis=1)
            return _looking(places, np.array([0, 0, 0.3]), size, self.angle_deg)
        azimuth = np.deg2rad(-90 + generator.uniform(25, 50) * generator.uniform(-1, 1, views))
        rise = np.deg2rad(generator.uniform(10, 45, views))
        flat, middle = np.cos(rise), np.array([0, 0, 0.2])
        towards = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(rise)], axis=1)
        return _looking(middle + 4.1 * towards, middle, size, 40.0)


def drawn_cases(seed: int) -> Iterator[Case]:
    """Twelve closed rooms, six skies, six walls and corners of random sizes, colours and cameras."""
    generator = np.random.default_rng(seed)

    def colours(count: int, most: int) -> list[str]:
        few = generator.choice(MATERIALS, most, replace=False)
        return [str(name) for name in generator.choice(few, count)]

    def cameras(kind: Literal["ring", "dome", "one side", "before a wall"]) -> _DrawnCameras:
        away, angle_deg = generator.uniform((2.2, 42), (3.0, 65))
        return _DrawnCameras(kind, int(generator.integers(1 << 30)), float(away), float(angle_deg))

    dark, nothing = _sky("white", 0.0), {**_FITS, "backdrop": "none"}
    kinds: tuple[Literal["ring", "dome", "one side"], ...] = ("ring", "dome", "one side")
    for number in range(12):
        kind, materials = kinds[number % 3], colours(4, 1 + number // 3)
        reach = float(generator.uniform(4.3, 6.0) if kind == "dome" else generator.uniform(3.3, 5.5))
        place = Place((*THINGS, *_room(reach, *materials)), cameras(kind), dark)
        yield Case(
            f"room {number}, {kind}, {reach:.1f}, {', '.join(materials)}",
            "rooms",
            place,
            nothing,
            can_train=True,
        )
    found: Truth = {**_FITS, "backdrop": "found"}
    for number in range(6):
        material, level = colours(1, 1)[0], float(generator.uniform(0.05, 0.9))
        place = Place(THINGS, cameras(kinds[number % 2]), _sky(material, level))
        yield Case(f"before {material} {level:.2f}", "backdrops", place, found, can_train=True)
    for number in range(6):
        away, (floor, left, right) = float(generator.uniform(1.6, 4.0)), colours(3, 1 + number // 2)
        things = _corner(away, floor, left, right) if number % 2 else _wall(away, floor, left)
        what = (
            f"a corner {away:.1f} away, {floor}, {left}, {right}"
            if number % 2
            else f"a wall {away:.1f} away, {left}"
        )
        place = Place((*THINGS, *things), cameras("before a wall"), dark)
        yield Case(f"before {what}", "walls and corners", place, nothing, can_train=True)


def _floors() -> Iterator[tuple[str, np.ndarray]]:
    rows, columns = np.mgrid[:600, :600]
    generator = np.random.default_rng(0)
    bumps = np.sum([ndimage.gaussian_filter(generator.random((600, 600)), w) * w for w in (2, 4, 9)], axis=0)
    bumps = (bumps - bumps.min()) / np.ptp(bumps)
    patterns = {
        "checks": 0.3 + 0.4 * ((columns // 22 + rows // 22) % 2),
        "stripes": 0.3 + 0.4 * (columns // 18 % 2),
        "gingham": 0.2 + 0.3 * (columns // 20 % 2) + 0.3 * (rows // 20 % 2),
        "stripes across": 0.2 + 0.3 * (columns // 20 % 2) + 0.3 * ((columns + rows) // 28 % 2),
    }
    yield "bumps", bumps
    for name, pattern in patterns.items():
        yield name, ndimage.gaussian_filter(pattern, 1.0)
        printed = np.where(np.hypot(columns - 300, rows - 300) < 90, bumps, pattern)
        yield f"{name} around a print", ndimage.gaussian_filter(printed, 1.0)


def _floor_views(folder: Path, texture: np.ndarray) -> list[tuple[PosedCamera, Path]]:
    """Six views of a floor, 10 degrees apart."""
    size, focal, count = 200, 100.0, 6
    lens = Lens(size, size, (focal, focal), (size / 2, size / 2))
    turns = np.radians(10.0 * np.arange(count))
    heights = 2.0 + 0.2 * (np.arange(count) % 2)
    places = np.stack([2.2 * np.cos(turns), 2.2 * np.sin(turns), heights], axis=1)
    cameras = _looking(places, np.zeros(3), size, 90.0)
    generator, views = np.random.default_rng(1), []
    for index in range(count):
        rays = cameras[index].image_rays(0).directions.double().numpy()
        x, y, _ = (places[index] - places[index, 2] / rays[:, 2:] * rays).T
        shown = ndimage.map_coordinates(texture, [300 + 90 * y, 300 + 90 * x], order=1, mode="mirror")
        noisy = shown.reshape(size, size) + 0.01 * generator.standard_normal((size, size))
        path = folder / f"{index}.png"
        Image.fromarray((255 * noisy.clip(0, 1)).astype(np.uint8)).save(path)
        views.append((PosedCamera(cameras.camera_to_world[index].double().numpy(), lens), path))
    return views


def judge_floors(folder: Path, floors: Sequence[tuple[str, np.ndarray]]) -> Iterator[dict[str, Any]]:
    """Whether true poses are called wrong."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, texture in floors:
        codes = {remark.code for remark in check_matches(MatchedScene.of(_floor_views(folder, texture)))}
        is_found = not codes.isdisjoint({Code.LENS_MISFITS, Code.POSES_MISFIT})
        outcome = "do not fit" if is_found else "no finding"
        yield _row(f"floor, {name}", "patterns that repeat", "matches", outcome, "no finding")


def _row(case: str, kind: str, subject: str, outcome: str, expected: str | tuple[str, ...]) -> dict[str, Any]:
    verdict = UNDECIDED if outcome == UNDECIDED else "right" if outcome.startswith(expected) else "wrong"
    return {"case": case, "kind": kind, "subject": subject, "outcome": outcome, "verdict": verdict}


def judge_case(case: Case, scene: Path) -> Iterator[dict[str, Any]]:
    """What is decided of a scene, against the truth."""
    config = parse(["unmix-nerf", "--data", str(scene), "--device", "cpu"])[0]
    try:
        outcomes = {one.subject: one.outcome for one in prepare_steps(config)[1].pipeline.decisions}
    except SceneError:
        outcomes = {}
    for subject, expected in case.truth.items():
        yield _row(case.name, case.kind, subject, outcomes.get(subject, _REFUSED), expected)


def psnr_of(scene: Path, world: str, steps: int, runs: Path) -> float:
    """Of the evaluation views, after so many steps."""
    words = ["unmix-nerf", "--data", str(scene), "--device", "cpu", "--world", world]
    words += ["--output-dir", str(runs), "--max-num-iterations", str(steps)]
    trainer = _common.quiet_trainer(words)
    _common.take_steps(trainer, range(steps), steps)
    return _common.evaluated_psnr(trainer)


def main(options: Options) -> None:
    """Judge and publish."""
    chosen, floors = list(cases() if options.seed is None else drawn_cases(options.seed)), list(_floors())
    if options.quick:
        options = replace(options, size=48, views=16)
        chosen, floors = chosen[::10], floors[::4]
    rows: list[dict[str, Any]] = []
    lost: dict[str, float] = {}
    with ExitStack() as stack:
        folder = options.folder or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-decisions-"))
        )
        trainable = [case for case in chosen if case.can_train]
        trained = [] if options.train_steps is None else trainable[:: options.train_each]
        for number, case in enumerate(chosen):
            scene = folder / f"{number:02d}"
            if not scene.is_dir():
                make_demo_scene(scene, options.size, _BANDS, options.views, place=case.place)
                if case.change is not None:
                    case.change(scene)
            rows += judge_case(case, scene)
            print(f"{case.name}: {rows[-1]['outcome']} ({rows[-1]['verdict']})", flush=True)
            if options.train_steps is not None and case in trained:
                reached = {
                    world: psnr_of(scene, world, options.train_steps, folder / "runs")
                    for world in ("auto", "bounded", "unbounded")
                }
                lost[case.name] = max(reached.values()) - reached["auto"]
        rows += judge_floors(folder / "floors", floors)
    report(options, len(chosen) + len(floors), rows, lost)


def report(options: Options, count: int, rows: list[dict[str, Any]], lost: dict[str, float]) -> None:
    """Count verdicts by subject and kind, and publish."""
    verdicts: dict[str, Counter[str]] = defaultdict(Counter)
    for row in rows:
        verdicts[row["subject"]][row["verdict"]] += 1
    figures = []
    for subject, found in verdicts.items():
        figures.append(_WRONG_LIMIT.judge(f"{subject}: wrong, of {found.total()}", found["wrong"]))
        figures.append(_UNDECIDED_LIMIT.judge(f"{subject}: undecided, of {found.total()}", found[UNDECIDED]))
    if lost:
        limit = _common.Limit(0.3, is_upper=True, unit=" dB")
        worst = max(lost, key=lambda name: lost[name])
        figures.append(limit.judge(f"PSNR lost against the best flag, most ({worst})", lost[worst]))
    setting = {
        "scenes": count,
        "size": options.size,
        "views": options.views,
        "steps": options.train_steps,
        "trained": len(lost),
        "seed": options.seed,
    }
    other = [list(map(str, row.values())) for row in rows if row["verdict"] != "right"]
    tables = [_common.DetailTable("not right", ["case", "kind", "subject", "outcome", "verdict"], other)]
    if lost:
        losses = [[name, f"{value:.2f}"] for name, value in sorted(lost.items(), key=lambda one: -one[1])]
        tables.append(_common.DetailTable("PSNR lost, dB", ["case", "lost"], losses))
    question = "Automatic decisions on scenes of which the truth is known"
    details = {"decisions": rows, "lost_db": lost}
    machine = _machine.describe_machine("cpu")
    name = "decisions" if options.seed is None else "decisions-drawn"
    _common.publish(
        _common.Report(name, question, setting, machine, figures, details, tuple(tables)),
        _common.results_folder(options.results, options.quick),
    )


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
