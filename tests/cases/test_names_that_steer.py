"""Files whose names and texts would steer a terminal: whatever a command prints or notes down of them can't."""

from __future__ import annotations

import os
import unicodedata

import h5py
import numpy as np
import pytest

from tests.factories.commands import SMALL_METHOD, run
from tests.factories.forms import VIEWS, WAVELENGTHS_NM, cube, processed, write_envi, write_transforms
from unmix_plugin.commands.process import process
from unmix_plugin.commands.train import train

STEERS = "\x1b]0;x\x07\x1b[2J\x9b31m\u202egnp"
needs_any_name = pytest.mark.skipif(os.name == "nt", reason="Windows allows no control characters in names")


def check_clean(*texts):
    """That no text has a letter that steers, and that any was shown at all."""
    for text in texts:
        steering = [one for one in text if unicodedata.category(one) == "Cc" and one not in "\t\n"]
        assert not steering
        assert "\u202e" not in text
    assert any("gnp" in text for text in texts)


@needs_any_name
@pytest.mark.usefixtures("contact_sheet")
def test_the_name_of_a_folder_and_of_its_views(tmp_path):
    root = tmp_path / f"capture{STEERS}"
    names = [f"view{STEERS}_{index:03d}" for index in range(VIEWS)]
    for index, name in enumerate(names):
        write_envi(root / f"{name}.hdr", cube(index).astype(np.float32))
    write_transforms(root / "transforms.json", names)
    scene = processed(
        "cubes", "--data", root, "--poses", "transforms.json", output=tmp_path / f"scene{STEERS}"
    )
    check_clean(scene.printed, (scene.root / "report.txt").read_text(encoding="utf-8"))
    where = "--data", scene.root, "--output-dir", tmp_path / "outputs"
    ended = run(train, "unmix-nerf", *where, "--max-num-iterations", 1, "--endmembers", 2, *SMALL_METHOD)
    assert ended.status == 0
    logs = [path.read_text(encoding="utf-8") for path in tmp_path.rglob("run.log")]
    check_clean(ended.out, ended.err, *logs)


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_band_names_of_an_envi_header(words, tmp_path):
    names = "{" + ", ".join(f"{STEERS} {nm:g} nm" for nm in WAVELENGTHS_NM) + "}"
    write_envi(tmp_path / "view.hdr", cube(0).astype(np.float32), wavelength=None, band_names=names)
    ended = run(process, "inspect", tmp_path / "view.hdr", *words)
    check_clean(ended.out, ended.err)


def test_names_in_hdf5(tmp_path):
    with h5py.File(tmp_path / "view.h5", "w") as file:
        for name in ("a", "b"):
            file[name + STEERS] = cube(0).astype(np.float32)
    ended = run(process, "inspect", tmp_path / "view.h5")
    check_clean(ended.out, ended.err)


def test_names_in_transforms_json(tmp_path):
    write_transforms(
        tmp_path / "transforms.json",
        [f"{index}.png" for index in range(VIEWS)],
        of_frame=lambda index: {"hyperspectral_file_path": f"{STEERS}{index}.npy"},
        wavelengths=WAVELENGTHS_NM.tolist(),
    )
    ended = run(train, "unmix-nerf", "--data", tmp_path, "--output-dir", tmp_path / "outputs", *SMALL_METHOD)
    assert ended.status == 2
    check_clean(ended.out, ended.err)
