"""What is wrong with a capture is reported in one message with exit status 2, and nothing like a scene is left."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.factories.captures import (
    BANDS,
    HEIGHT,
    WAVELENGTHS_NM,
    WIDTH,
    make_capture,
    process,
    write_cube,
    write_poses,
)
from tests.factories.commands import done, refused
from unmix_plugin.commands.process import process as process_command
from unmix_plugin.errors import UnmixError

Spoil = Callable[[Path], Any]
COUNTS = np.full((HEIGHT, WIDTH, BANDS), 500, np.uint16)
MOVED = ", ".join(f"{value + 3:g}" for value in WAVELENGTHS_NM)
BACKWARDS = ", ".join(f"{value:g}" for value in WAVELENGTHS_NM[::-1])
REFERENCES = {"white": "white.hdr", "dark": "dark.hdr"}


def _zero_poses(root: Path) -> None:
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = np.zeros((4, 4)).tolist()
    path.write_text(json.dumps(content))


def _bytes(name: str, data: bytes) -> Spoil:
    return lambda root: (root / name).write_bytes(data)


def _cube(name: str, values: np.ndarray = COUNTS, **header: Any) -> Spoil:
    return lambda root: write_cube(root, name, values, header=header)


def _poses_of(*names: str, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Spoil:
    return lambda root: write_poses(root / "transforms.json", list(names), *size)


def _all_views(value: int = 500, **header: Any) -> Spoil:
    names = ("view_00", "view_01", "view_02", "view_03")
    return lambda root: [write_cube(root, name, np.full_like(COUNTS, value), header=header) for name in names]


OPTIONS: list[tuple[dict[str, Any], str]] = [
    ({"white": "dark.hdr", "dark": "white.hdr"}, "not brighter than the dark .* white and dark swapped"),
    ({"white": "nowhere.hdr"}, r"--white .*nowhere\.hdr: no such file"),
    ({"wavelengths": "500,600"}, "2 wavelengths were given for .* 9 bands"),
    ({"wavelengths": "500,inf"}, "500,inf holds NaN or infinity; expected"),
    ({"wavelengths": "0.5,0.6"}, "look like micrometres"),
    ({"wavelengths": "red,green"}, "neither a list of numbers, .* nor a CSV file"),
    ({"poses": None}, "the layout 'cubes' has no poses.*; give --poses"),
    ({"poses": "nowhere.json"}, r"nowhere\.json is not there"),
    ({"crop": (10, 10, 20, 20)}, "--crop 10 10 20 20 .* leaves the image"),
    ({"bin_pixels": 20}, "--bin-pixels 20 leaves fewer than 2 x 2"),
    ({"bin_bands": 0}, "--bin-bands 0: expected 1 or more"),
    ({"bin_bands": 10}, "9 of 9 bands are left, 10 or more are needed; lower --bin-"),
    ({"drop_bands": "400-900"}, "0 of 9 bands are left, 1 or more are needed"),
    ({"drop_bands": "1400"}, "no band in '1400' nm; the bands lie at 450 to 850"),
    ({"drop_bands": "red"}, "'red' is not a wavelength or range"),
    (REFERENCES | {"white_rectangle": ("view_00", 0, 0, 4, 4)}, "--white and --white-rectangle both"),
    ({"white_rectangle": ("cow", 0, 0, 4, 4)}, "--white-rectangle cow"),
    ({"white_rectangle": ("view_00", 20, 0, 10, 4)}, "view_00 20 0 10 4 .* leaves the image"),
    (REFERENCES | {"white_reflectance": "99"}, "is 99 to 99; expected"),
    (REFERENCES | {"white_reflectance": "a.csv"}, "expected a number such as"),
    ({"white_reflectance": "0.5"}, "--white-reflectance needs a white reference"),
    ({"mask": "files"}, "--mask files: view view_00 has no mask"),
    ({"mask": "white"}, "--mask white: the border of the views is at"),
    ({"scale": 0.0}, "--scale 0: expected a number above 0"),
    ({"saturation": float("nan")}, "--saturation nan: expected a stored number"),
    ({"max_noise": 0.0}, "--max-noise 0: expected a share above 0"),
]
LFS = b"version https://git-lfs.github.com/spec/v1\n"
NO_NM: dict[str, Any] = {"wavelength": None, "wavelength units": None}
FACTOR: dict[str, Any] = {"reflectance scale factor": 10000}
IGNORED: dict[str, Any] = {"data ignore value": 7}
SPOILT: list[tuple[Spoil, dict[str, Any], str]] = [
    (lambda root: np.save(root / "view_01.npy", COUNTS), {}, "npy would both be the view 'view_01'"),
    (_cube("view_01", COUNTS[..., :5]), {}, r"view_01\.hdr has 24 x 32 x 5 .*; expected 24 x 32 x 9"),
    (_cube("view_02", COUNTS[:10]), {}, r"view_02 has 32 x 10 pixels .* 32 x 24; expected the same shape"),
    (_cube("view_01", wavelength=f"{{{MOVED}}}"), {}, r"view_01\.hdr has 453 nm at band 0; expected 450 nm"),
    (_cube("view_01", COUNTS.astype(np.float32)), {}, "holds float32; expected uint16"),
    (_cube("view_01", **FACTOR), {}, r"view_00\.hdr has no gains or scale, .*factor"),
    (_cube("white", wavelength=f"{{{BACKWARDS}}}"), REFERENCES, "hdr has 850 nm at band 0; expected 450"),
    (_bytes("view_01.raw", bytes(1000)), {}, r"01\.raw: cut short: 1000 bytes; view_01\.hdr promises 13824"),
    (_bytes("view_09.tif", LFS), {}, r"09\.tif: a pointer of Git LFS, .*; fetch it with 'git lfs pull'"),
    (_cube("view_01", lines=10**9, samples=10**6), {}, r"view_01\.hdr promises 18000000000000000"),
    (_cube("white", COUNTS[..., :4]), REFERENCES, "the white reference has 4 bands, the cubes have 9"),
    (_cube("white", 0 * COUNTS + 4095), REFERENCES | {"saturation": 4095.0}, "100% of the white reference"),
    (_all_views(50), {"dark": "dark.hdr"}, "not above 0 .*; check the dark frame"),
    (_all_views(7, **IGNORED), {"saturation": 4000.0}, "no sampled pixel .* in all bands"),
    (_all_views(**NO_NM), {}, "the wavelengths of its 9 bands are unknown .* --wavelengths"),
    (_zero_poses, {}, "4 of 4 camera matrices that are not poses: .* the rotation is all zeros"),
    (_poses_of("cow", "horse"), {}, "no view has a pose"),
    (_poses_of("view_00", "view_01", size=(100, 40)), {}, "has 32 x 24 .*, its lens is given for 100 x 40"),
]


BAD = [*((Path.is_dir, *case) for case in OPTIONS), *SPOILT]


@pytest.mark.parametrize(("spoil", "options", "message"), BAD, ids=lambda _: "")
def test_a_bad_capture_is_refused(tmp_path: Path, spoil: Spoil, options: dict[str, Any], message: str):
    capture = make_capture(tmp_path / "capture")
    spoil(capture.root)
    files = {key: capture.root / options[key] for key in ("white", "dark") if key in options}
    with pytest.raises(UnmixError, match=message) as caught:
        process(capture.root, tmp_path / "scene", **options | files)
    assert "\n" not in str(caught.value).strip()
    assert not (tmp_path / "scene").exists()
    assert not (tmp_path / "scene.unfinished" / "transforms.json").exists()


@pytest.mark.parametrize(
    ("layout", "folder", "message"),
    [
        ("cubes", "nowhere", "nowhere is not there; give the folder of the capture with --data"),
        ("cube", ".", "did you mean cubes?"),
        ("cubes", ".", "holds no cubes; expected one file per view"),
    ],
)
def test_the_command_ends_with_the_users_error(tmp_path: Path, layout: str, folder: str, message: str):
    words = ["--data", tmp_path / folder, "--output-dir", tmp_path / "scene", "--poses", "transforms.json"]
    assert message in refused(process_command, layout, *words)


@pytest.mark.usefixtures("contact_sheet")
def test_the_command_ends_with_the_name_of_the_scene(tmp_path: Path):
    words = ["--data", make_capture(tmp_path / "capture").root, "--output-dir", tmp_path / "scene"]
    ended = done(process_command, "cubes", *words, "--poses", "transforms.json", "--drop-bands", "500")
    assert ended.last_line == f"scene: {tmp_path / 'scene'}"
    assert (tmp_path / "scene" / "contact-sheet.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("scene/file.txt", "is not empty; give a new folder"),
        ("scene/folder/precious.txt", "is not empty; give a new folder"),
        ("scene.unfinished/precious.txt", "is in the way and was not made by unmix-process"),
    ],
)
def test_an_output_with_something_in_it_is_left_alone(tmp_path: Path, name: str, message: str):
    capture = make_capture(tmp_path / "capture")
    path = tmp_path / name
    path.parent.mkdir(parents=True)
    path.write_text("precious")
    with pytest.raises(UnmixError, match=message):
        process(capture.root, tmp_path / "scene", overwrite=True)
    assert path.read_text() == "precious"
