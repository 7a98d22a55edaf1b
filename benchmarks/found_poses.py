"""Are poses found where structure from motion has little to hold on to: by printed markers, and on turntables?

    python benchmarks/found_poses.py --folder DIR [--turntable SCENE] [--basil FOLDER]

The demo scene as raw counts with a board of markers, solved by the markers alone; the same objects without any pattern,
on a turntable before a lamp that stands still as the camera does, and with the board; a rendered turntable and a
photographed plant whose poses are kept back, if their folders are given. Poses are compared with the true ones after a
similarity, in pixels of projected points. What a part has measured stays in the folder, and is not measured again.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import _common
import _machine
import numpy as np
import tyro

MOST_OFF = _common.Limit(0.3, is_upper=True, unit=" px")
MOST_OFF_PLAIN = _common.Limit(1.0, is_upper=True, unit=" px")
MOST_OFF_SCALE = _common.Limit(0.005, is_upper=True)
ALL = _common.Limit(1.0)
PSNR_LOSS = _common.Limit(1.0, is_upper=True, unit=" dB")
PLAIN_SIZE, PLAIN_BANDS, PLAIN_VIEWS = 320, 12, 36
RING_ELEVATION_DEG = 28.0
ANGLES = f"0:360:{360 // PLAIN_VIEWS}"
BASIL_ANGLES = "0:375:15,0:375:15"
"""Two turns, each a little more than once around; the steps are those of its COLMAP model, which are uneven."""
WAVELENGTHS = "610,550,465"


@dataclass(frozen=True)
class Options:
    """Find poses by markers and turntables."""

    folder: Path
    """Keep captures, scenes, runs and what was measured here."""
    turntable: Path | None = None
    """A scene of an object on a turntable whose axis is z, such as `turntable` of scenes.py."""
    basil: Path | None = None
    """The files of "Basil" of HS-NeRF: images/ and colmap/."""
    steps: int = 600
    """Of each training on the turntable."""
    board: Path | None = None
    """A raw capture with a board (unmix-demo-scene --raw --markers), if it is there already."""
    results: Path | None = None
    """Folder for found_poses.json and found_poses.md; None: beside the benchmarks."""


def main(options: Options) -> None:
    """Measure and publish."""
    options.folder.mkdir(parents=True, exist_ok=True)
    parts: dict[str, Callable[[Options], Any]] = {
        "board": with_board,
        "plain_markers": plain_with_board,
        "plain_turntable": partial(plain_on_turntable, words=("turntable", "--angles", ANGLES)),
        "plain_estimate": partial(plain_on_turntable, words=("estimate",)),
    }
    parts |= {} if options.turntable is None else {"turntable": on_turntable}
    parts |= {} if options.basil is None else {"basil": on_basil}
    measured = {}
    for name, part in parts.items():
        record = options.folder / f"{name}.json"
        if not record.is_file():
            print(f"{name} ...", flush=True)
            record.write_text(json.dumps(part(options)), encoding="utf-8")
        measured[name] = json.loads(record.read_text(encoding="utf-8"))
    setting = {
        "plain objects": f"{PLAIN_VIEWS} views of {PLAIN_SIZE} px, every surface of one material",
        "steps of trainings": options.steps,
    }
    question = "Poses by printed markers and on turntables, beside the true ones"
    report = _common.Report(
        "found_poses", question, setting, _machine.describe_machine(), judge(measured), measured, ()
    )
    _common.publish(report, _common.results_folder(options.results, quick=False))


def with_board(options: Options) -> dict[str, Any]:
    """The raw demo with its board, at its usual size."""
    capture = options.board or options.folder / "board-capture"
    if not capture.is_dir():
        _common.run_command([_common.console_script("unmix-demo-scene"), str(capture), "--raw", "--markers"])
    return by_markers(options.folder / "board", capture)


def plain_with_board(options: Options) -> dict[str, Any]:
    """Objects without a pattern, with the board around them."""
    from unmix_plugin.captures.demo import make_demo_capture, marked_place

    capture = options.folder / "plain-board-capture"
    if not capture.is_dir():
        place = marked_place(plain_things())
        make_demo_capture(capture, PLAIN_SIZE, PLAIN_BANDS, PLAIN_VIEWS, place=place)
    return by_markers(options.folder / "plain-board", capture)


def by_markers(scene: Path, capture: Path) -> dict[str, Any]:
    """What the markers alone give."""
    from unmix_plugin.captures.demo import MARKER_SIZE

    process(capture, scene, "markers", "--marker-size", str(MARKER_SIZE))
    return errors(scene, capture / "poses-true.json")


def plain_on_turntable(options: Options, words: tuple[str, ...]) -> dict[str, Any]:
    """Objects without a pattern, turned before a camera and a lamp that stand still."""
    capture = options.folder / "plain-ring-capture"
    if not capture.is_dir():
        make_ring(capture)
    scene = options.folder / f"plain-{words[0]}"
    if refusal := process(capture, scene, *words):
        return {"registered": 0, "views": PLAIN_VIEWS, "refused": refusal}
    return errors(scene, capture / "poses-true.json")


def plain_things() -> list[Any]:
    """The demo's objects, each of its first material alone."""
    from unmix_plugin.scenes.demo.shading import THINGS, plain

    return [replace(thing, surface=replace(thing.surface, blend=plain)) for thing in THINGS]


def make_ring(capture: Path) -> None:
    """The capture of a turntable: as seen from the objects, camera and lamp go around them together."""
    from unmix_plugin.captures import demo
    from unmix_plugin.engine.geometry.camera_paths import upright_cameras
    from unmix_plugin.scenes.demo.scene import Place, demo_cameras
    from unmix_plugin.scenes.demo.shading import LAMP_POSITION, render_view

    def ring(size: int, views: int) -> Any:
        turn, up = 2 * np.pi * np.arange(views) / views, np.radians(RING_ELEVATION_DEG)
        flat = np.cos(up) * np.ones(views)
        backward = np.stack([flat * np.cos(turn), flat * np.sin(turn), np.sin(up) * np.ones(views)], axis=1)
        focal = float(demo_cameras(size, 4).focal_px[0, 0])
        return upright_cameras(
            np.array([0.05, -0.04, 0.25]) + 4.3 * backward, backward, size, 2 * np.arctan(size / 2 / focal)
        )

    def lit_from_beside(cameras: Any, index: int, things: Any) -> Any:
        turn = 2 * np.pi * index / len(cameras)
        x, y, z = LAMP_POSITION
        lamp = (x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z)
        return render_view(cameras, index, things=things, lamp=lamp)

    with mock.patch.object(demo, "render_view", lit_from_beside):
        demo.make_demo_capture(
            capture, PLAIN_SIZE, PLAIN_BANDS, PLAIN_VIEWS, place=Place(plain_things(), ring)
        )


def process(capture: Path, scene: Path, *poses: str) -> str | None:
    """Make a scene of a raw capture; what was said if it was refused."""
    words = ["cubes", "--data", str(capture), "--output-dir", str(scene), "--mask", "black", "--overwrite"]
    for what in ("white", "dark"):
        words += [f"--{what}", str(capture / f"{what}.hdr")]
    return attempt([*words, "--poses", *poses])


def attempt(words: list[str]) -> str | None:
    """Run unmix-process; the first sentence of the message if it refuses."""
    from tests.factories.commands import run
    from unmix_plugin.commands.process import process as command

    ended = run(command, *words)
    if ended.status not in (0, 2):
        raise RuntimeError(ended.err)
    return ended.err.split(". ")[0] if ended.status else None


def errors(scene: Path, truth_file: Path) -> dict[str, Any]:
    """Registered views, how far they are from the truth, and what unmix-process said of them."""
    from tests.factories.poses import align_poses
    from unmix_plugin.captures.poses.reading import read_poses

    found, truth = read_poses(scene / "transforms.json"), read_poses(truth_file)
    by_stem = {Path(name).stem: name for name in truth.cameras}
    pairs = {name: by_stem[Path(name).stem] for name in found.cameras}
    aligned = align_poses(replace(found, points=None), truth, pairs)
    lenses = [next(iter(poses.cameras.values())).lens for poses in (found, truth)]
    assert lenses[0] is not None
    assert lenses[1] is not None
    return {
        "registered": len(pairs),
        "views": len(truth.cameras),
        "rms_px": aligned.rms_px,
        "largest_px": float(aligned.errors_px.max()),
        "scale_error": abs(aligned.similarity.scale - 1.0),
        "focal_error": lenses[0].focal_px[0] / lenses[1].focal_px[0] - 1.0,
        "notes": json.loads((scene / "process.json").read_text(encoding="utf-8"))["poses"]["notes"],
    }


def on_turntable(options: Options) -> dict[str, Any]:
    """A rendered turntable without its poses, with true ones, and trainings on both."""
    assert options.turntable is not None
    capture = options.folder / "turntable-capture"
    content = json.loads((options.turntable / "transforms.json").read_text(encoding="utf-8"))
    capture.mkdir(exist_ok=True)
    rows = ["view,angle,camera"]
    places = np.array([frame["transform_matrix"] for frame in content["frames"]])[:, :3, 3]
    angles = np.degrees(np.arctan2(places[:, 1], places[:, 0])) % 360
    heights, cameras = np.unique(np.round(places[:, 2], 6), return_inverse=True)
    print(f"turntable: {len(heights)} heights of the camera", flush=True)
    for frame, angle, camera in zip(content["frames"], angles - angles[0], cameras, strict=True):
        stem = Path(frame["file_path"]).stem
        shutil.copy(options.turntable / frame["hyperspectral_file_path"], capture / f"{stem}.npy")
        shutil.copy(options.turntable / frame["file_path"], capture / f"{stem}.png")
        rows.append(f"{stem},{angle:.6f},{camera}")
    table = options.folder / "angles.csv"
    table.write_text("\n".join(rows) + "\n", encoding="utf-8")
    given = str(options.turntable / "transforms.json")
    wavelengths = ",".join(f"{value:g}" for value in content["wavelengths"])
    result = {}
    for kind, poses in (("found", ["turntable", "--angles", str(table)]), ("true", [given])):
        scene = options.folder / f"turntable-{kind}"
        words = [
            "cubes",
            "--data",
            str(capture),
            "--output-dir",
            str(scene),
            "--mask",
            "files",
            "--overwrite",
        ]
        refusal = attempt([*words, "--wavelengths", wavelengths, "--poses", *poses])
        assert refusal is None, refusal
        result |= {f"{kind}_psnr": trained_psnr(scene, options.steps)}
    return result | errors(options.folder / "turntable-found", options.turntable / "transforms.json")


def trained_psnr(scene: Path, steps: int) -> float:
    """On matter of the evaluation views."""
    path = scene / "transforms.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    names: dict[bool, list[str]] = {True: [], False: []}
    for frame in content["frames"]:
        names[Path(frame["file_path"]).stem.startswith("eval")].append(frame["file_path"])
    content |= {"train_filenames": names[False], "val_filenames": names[True], "test_filenames": names[True]}
    path.write_text(json.dumps(content), encoding="utf-8")
    words = ["unmix-nerf", "--data", str(scene), "--endmembers", "6", "--light", "camera"]
    words += ["--max-num-iterations", str(steps), "--output-dir", str(scene.parent / "runs")]
    trained = _common.run_command([_common.console_script("unmix-train"), *words])
    _common.run_command([_common.console_script("unmix-eval"), "--run", str(trained.run)])
    metrics = json.loads((trained.run / "eval" / "metrics.json").read_text(encoding="utf-8"))
    return float(metrics["psnr"])


def on_basil(options: Options) -> dict[str, Any]:
    """Photographs of a plant that was turned by hand, beside the poses that COLMAP gave its authors."""
    from _basil import make_scene

    assert options.basil is not None
    made = make_scene(options.basil, options.folder / "basil-made")
    scene = options.folder / "basil-turntable"
    words = [
        "cubes",
        "--data",
        str(made / "images"),
        "--output-dir",
        str(scene),
        "--wavelengths",
        WAVELENGTHS,
    ]
    words += ["--mask", "files", "--overwrite", "--poses", "turntable", "--angles", BASIL_ANGLES]
    if refusal := attempt(words):
        return {"registered": 0, "views": 50, "refused": refusal}
    return errors(scene, options.basil / "colmap")


def judge(measured: Mapping[str, Any]) -> list[_common.Figure]:
    """What was asked of each part."""
    figures = []
    for name, title, limit in (
        ("board", "speckled objects, markers", MOST_OFF),
        ("plain_markers", "plain objects, markers", MOST_OFF_PLAIN),
        ("plain_turntable", "plain objects, turntable", MOST_OFF_PLAIN),
        ("plain_estimate", "plain objects, structure from motion", None),
        ("turntable", "rendered turntable", MOST_OFF_PLAIN),
        ("basil", "Basil, turntable, beside COLMAP's", None),
    ):
        part = measured.get(name)
        if part is None:
            continue
        if limit is None:
            said = f"{part['registered']} of {part['views']}"
            figures.append(_common.reported(f"{title}: views with poses", said))
            off = f"{part['rms_px']:.3g} px" if "rms_px" in part else "refused"
            figures.append(_common.reported(f"{title}: pixels off", off))
            continue
        figures.append(ALL.judge(f"{title}: share of views with poses", part["registered"] / part["views"]))
        figures.append(limit.judge(f"{title}: pixels off, root mean square", part["rms_px"]))
        if "markers" in name or name == "board":
            figures.append(MOST_OFF_SCALE.judge(f"{title}: scale off, share", part["scale_error"]))
        if "found_psnr" in part:
            figures.append(PSNR_LOSS.judge(f"{title}: PSNR lost", part["true_psnr"] - part["found_psnr"]))
    return figures


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
