"""The smallest scenes there can be: each is processed and trained, or refused by its cause; none is a bug of ours."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.factories.commands import SMALL_METHOD, run
from tests.factories.forms import WAVELENGTHS_NM, cube, ring, write_envi, write_transforms
from unmix_plugin.commands.process import process
from unmix_plugin.commands.train import train
from unmix_plugin.spectral.library.spectra_csv import read_spectra

SIZE = 16


def textured(index):
    return cube(index, SIZE, SIZE)


def with_nan_rim(index):
    values = textured(index)
    values[[0, -1]] = np.nan
    values[:, [0, -1]] = np.nan
    return values


def on_black(index):
    """A lit square before what reflects nothing."""
    values = np.zeros((SIZE, SIZE, len(WAVELENGTHS_NM)))
    values[4:12, 4:12] = textured(index)[4:12, 4:12]
    return values


def of_one_value(_index):
    return np.full((SIZE, SIZE, len(WAVELENGTHS_NM)), 0.4)


def without_texture(_index):
    return np.broadcast_to(
        np.linspace(0.2, 0.6, len(WAVELENGTHS_NM)), (SIZE, SIZE, len(WAVELENGTHS_NM))
    ).copy()


def black(_index):
    return np.zeros((SIZE, SIZE, len(WAVELENGTHS_NM)))


def missing(_index):
    return np.full((SIZE, SIZE, len(WAVELENGTHS_NM)), np.nan)


def only_some_plain(index):
    """Every second view shows a plain floor before a plain wall, the others texture up to their rims."""
    if index % 2 == 0:
        return textured(index)
    values = np.where(np.arange(SIZE)[:, None, None] < 9, 0.7, 0.4) * np.ones((SIZE, len(WAVELENGTHS_NM)))
    values[5:12, 5:11] = textured(index)[5:12, 5:11]
    return values


CAMERA = {"focal_px": 20.0, "w": SIZE, "h": SIZE, "cx": SIZE / 2, "cy": SIZE / 2}


def names_of(views):
    return [f"view_{index:03d}" for index in range(views)]


def make_scene(tmp_path, picture, views):
    """How `unmix-process` ends on such views."""
    for index, name in enumerate(names_of(views)):
        write_envi(tmp_path / "capture" / f"{name}.hdr", picture(index).astype(np.float32))
    write_transforms(tmp_path / "capture/transforms.json", names_of(views), ring(views), **CAMERA)
    given = "--data", tmp_path / "capture", "--output-dir", tmp_path / "scene", "--poses", "transforms.json"
    return run(process, "cubes", *given)


def write_scene(root, picture, views):
    """A scene of such views as one writes it by hand."""
    root.mkdir()
    frames = []
    for name, pose, index in zip(names_of(views), ring(views), range(views), strict=True):
        np.save(root / f"{name}.npy", picture(index).astype(np.float32))
        frames.append({"hyperspectral_file_path": f"{name}.npy", "transform_matrix": pose.tolist()})
    lens = {"fl_x": 20.0, "fl_y": 20.0, "w": SIZE, "h": SIZE, "cx": SIZE / 2, "cy": SIZE / 2}
    content = {**lens, "wavelengths": WAVELENGTHS_NM.tolist(), "frames": frames}
    (root / "transforms.json").write_text(json.dumps(content))


def trained(tmp_path, *words):
    """How a training of two steps ends on the scene."""
    where = "--data", tmp_path / "scene", "--output-dir", tmp_path / "outputs"
    return run(
        train, "unmix-nerf", *where, "--max-num-iterations", 2, "--endmembers", 2, *SMALL_METHOD, *words
    )


@pytest.mark.parametrize(
    ("picture", "views"),
    [(textured, 2), (textured, 8), (with_nan_rim, 3), (on_black, 2), (on_black, 8), (only_some_plain, 3)],
)
def test_few_pixels_and_few_views_make_a_scene_that_trains(picture, views, tmp_path):
    assert make_scene(tmp_path, picture, views).status == 0
    ended = trained(tmp_path)
    assert (ended.status, ended.err) == (0, "")


REFUSED = {
    "one view": (textured, 1, "1 of 1 views has a pose; a scene needs 2 or more"),
    "one value": (of_one_value, 3, "the same value in every sampled pixel"),
    "no texture": (without_texture, 3, "the same value in every sampled pixel"),
    "black": (black, 3, "the same value in every sampled pixel"),
    "missing": (missing, 3, "no sampled pixel of it and of the other views has a measurement"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_makes_no_scene_is_refused_by_its_cause(kind, tmp_path):
    picture, views, cause = REFUSED[kind]
    ended = make_scene(tmp_path, picture, views)
    assert ended.status == 2
    assert cause in ended.err
    assert not (tmp_path / "scene").exists()


NO_TRAINING = {
    "one view": (textured, 1, "no frame is left to train on"),
    "one value": (
        of_one_value,
        2,
        "only 1 distinct pixels are neither dark nor saturated (of 256); ask for at most 1",
    ),
    "no texture": (without_texture, 3, "only 1 distinct pixels are neither dark nor saturated"),
    "black": (black, 3, "only 0 distinct pixels are neither dark nor saturated"),
    "missing": (missing, 3, "every pixel of the cube has a NaN, infinite or negative value"),
}


@pytest.mark.parametrize("kind", NO_TRAINING)
def test_a_scene_that_can_t_be_trained_on_is_refused_by_its_cause(kind, tmp_path):
    picture, views, cause = NO_TRAINING[kind]
    write_scene(tmp_path / "scene", picture, views)
    ended = trained(tmp_path, "--invalid-pixels", "mask")
    assert ended.status == 2
    assert cause in " ".join(ended.err.split())


def test_a_scene_of_one_value_trains_with_the_one_material_that_is_advised(tmp_path):
    write_scene(tmp_path / "scene", of_one_value, 3)
    ended = trained(tmp_path, "--endmembers", 1)
    assert (ended.status, ended.err) == (0, "")
    run_folder = Path(ended.last_line.removeprefix("run: "))
    np.testing.assert_allclose(read_spectra(run_folder / "endmembers.csv").spectra, 0.4, atol=0.05)
