"""A view that all others contradict is named, with what is wrong with it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import unmix_plugin
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.trained.view_fit import (
    FILE_NAME,
    Misfit,
    ViewFit,
    describe_misfits,
    left_by_best_shift,
    misfits,
    read_misfits,
    write_fits,
)

SOUND = ViewFit("", 0.1, 1.01, 0.1, 0.1, 1.0, 0.5)
SPOILT = {
    "another exposure": ({"error": 0.4, "factor": 0.6, "error_of_factor": 0.12, "sharpness": 0.6}, Misfit.EXPOSURE),
    "a blur": ({"error": 0.25, "sharpness": 0.3}, Misfit.BLUR),
    "a shift": ({"error": 0.3, "error_of_shift": 0.15, "spread": 0.3}, Misfit.POSE),
    "another pose": ({"error": 0.8, "factor": 0.8, "error_of_factor": 0.75, "spread": 0.6}, Misfit.POSE),
    "something in the way": ({"error": 0.4, "spread": 0.1}, Misfit.CONTENT),
}  # fmt: skip


def views(*spoilt: ViewFit, count: int = 12) -> list[ViewFit]:
    sound = [
        replace(SOUND, name=f"view_{i:02d}", error=0.08 + 0.01 * (i % 5)) for i in range(count - len(spoilt))
    ]
    return [*sound, *spoilt]


@pytest.mark.parametrize("name", SPOILT)
def test_what_is_wrong_is_what_makes_the_error_smaller(name):
    changed, reason = SPOILT[name]
    usual = {"error_of_factor": changed["error"], "error_of_shift": changed["error"]}
    spoilt = replace(SOUND, name="spoilt", **{**usual, **changed})
    assert misfits(views(spoilt)) == {"spoilt": reason}
    assert describe_misfits({"spoilt": reason})[0].startswith(
        f"spoilt does not fit the other views: {reason.value}"
    )


def test_a_shift_explains_a_moved_picture_but_no_error_at_the_border_alone():
    rng = np.random.default_rng(0)
    rendered = ndimage.gaussian_filter(rng.random((40, 48)), 2)
    counts = np.ones(rendered.shape, dtype=bool)
    moved = np.roll(rendered, (2, -1), axis=(0, 1))
    assert left_by_best_shift(moved, rendered, counts) < 1e-6
    at_the_border = rendered + 0.01 * rng.standard_normal(rendered.shape)
    at_the_border[:3] += 1.0
    assert left_by_best_shift(at_the_border, rendered, counts) > 0.9
    assert left_by_best_shift(moved, rendered, np.zeros_like(counts)) == 1.0


def test_no_view_is_named_where_all_fit_where_many_do_not_or_where_there_are_few():
    spoilt = [replace(SOUND, name=f"bad_{index}", error=0.6) for index in range(5)]
    assert misfits(views()) == {}
    assert misfits(views(*spoilt)) == {}
    assert misfits(views(spoilt[0], count=5)) == {}


def test_they_are_known_from_the_folder_of_the_run(tmp_path):
    assert read_misfits(tmp_path) == {}
    spoilt = replace(SOUND, name="spoilt", error=0.6, error_of_factor=0.6, error_of_shift=0.6)
    assert write_fits(tmp_path, views(spoilt)) == read_misfits(tmp_path) == {"spoilt": Misfit.POSE}


@pytest.mark.slow
def test_a_training_names_the_views_that_were_spoilt_and_no_others(tmp_path):
    scene = tmp_path / "scene"
    make_demo_scene(scene, 48, 5, 24)
    content = json.loads((scene / "transforms.json").read_text())
    train = [frame for frame in content["frames"] if "train" in frame["file_path"]]
    names = [frame["file_path"].rsplit("/", 1)[1].removesuffix(".png") for frame in train]
    train[3]["transform_matrix"] = train[12]["transform_matrix"]
    (scene / "transforms.json").write_text(json.dumps(content))
    for index, change in (
        (6, lambda cube: 0.55 * cube),
        (9, lambda cube: ndimage.gaussian_filter(cube, (2, 2, 0))),
    ):
        path = scene / train[index]["hyperspectral_file_path"]
        np.save(path, change(np.load(path).astype(np.float32)).astype(np.float16))
    unmix_plugin.train(scene, output_dir=tmp_path / "runs", device="cpu", max_num_iterations=250)
    [run] = (tmp_path / "runs" / "scene" / "unmix-nerf").iterdir()
    assert read_misfits(run) == {
        names[3]: Misfit.POSE,
        names[6]: Misfit.EXPOSURE,
        names[9]: Misfit.BLUR,
    }
    assert len(json.loads((run / FILE_NAME).read_text())["views"]) == len(train)
    assert f"{names[6]} does not fit the other views: exposure" in (run / "run.log").read_text()
