"""Spoilt views are found among good ones, named, and decide nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from tests.factories.captures import BANDS, HEIGHT, WIDTH, make_capture, process, write_cube
from unmix_plugin.captures.report import Code
from unmix_plugin.captures.spoilt import ViewPixels, judge_sharpness, judge_values, sharpness_of
from unmix_plugin.errors import CaptureError, ConfigError

VIEWS, FULL = 30, 1.2
REFERENCES = {"white": "white.hdr", "dark": "dark.hdr"}


def views_of(spoilt: dict[int, float], count: int = VIEWS) -> list[ViewPixels]:
    """Views of three materials whose light goes around the object, some exposed otherwise, with what is cut off."""
    spectra = np.random.default_rng(0).uniform(0.1, 0.6, (3, 8))
    views = []
    for index in range(count):
        generator = np.random.default_rng(index)
        shading = 0.6 + 0.3 * np.cos(2 * np.pi * index / count) * generator.uniform(0.8, 1.2, (500, 1))
        values = generator.dirichlet(np.ones(3), 500) @ spectra * shading * spoilt.get(index, 1.0)
        values = np.concatenate([values, np.zeros((300, 8))]) + 0.002 * generator.standard_normal((800, 8))
        views.append(ViewPixels(f"v{index}", np.minimum(values, FULL).astype(np.float32), values >= FULL))
    return views


@pytest.mark.parametrize(
    ("spoilt", "codes"),
    [
        ({}, {}),
        ({4: 0.0}, {"v4": Code.VIEW_BLACK}),
        ({4: 6.0}, {"v4": Code.VIEW_OVEREXPOSED}),
        ({4: 2.0}, {"v4": Code.VIEW_EXPOSED_OTHERWISE}),
        ({4: 0.5}, {"v4": Code.VIEW_EXPOSED_OTHERWISE}),
        ({4: 0.5, 5: 0.5}, {"v4": Code.VIEW_EXPOSED_OTHERWISE, "v5": Code.VIEW_EXPOSED_OTHERWISE}),
        ({0: 0.0, 9: 6.0, 29: 0.5}, {
            "v0": Code.VIEW_BLACK, "v9": Code.VIEW_OVEREXPOSED, "v29": Code.VIEW_EXPOSED_OTHERWISE,
        }),
        (dict.fromkeys(range(10, 20), 0.5), {}),  # a third of the views: the light is so
        (dict.fromkeys(range(0, 30, 2), 0.5), {}),  # every other one
    ],
)  # fmt: skip
def test_views_whose_values_are_spoilt_are_named_and_no_others(spoilt, codes):
    assert {name: found.code for name, found in judge_values(views_of(spoilt)).items()} == codes


def test_few_views_are_not_judged():
    assert judge_values(views_of({2: 0.0}, count=4)) == {}


@pytest.mark.parametrize("blur", [(15, 15), (1, 15), (15, 1), (5, 5)])
def test_a_blurred_view_is_named_beside_noise_and_none_falsely(blur):
    def sharpness(index: int, size: tuple[int, int]) -> list[float]:
        generator = np.random.default_rng(index)
        waves = [ndimage.gaussian_filter(generator.random((120, 160)), width) * width for width in (1, 3, 9)]
        picture = ndimage.uniform_filter1d(
            ndimage.uniform_filter1d(np.sum(waves, axis=0), size[0], 0), size[1], 1
        )
        noisy = picture + 0.002 * generator.standard_normal(picture.shape)
        return sharpness_of(noisy.astype(np.float32), np.ones(noisy.shape, bool))

    good = {f"v{index}": sharpness(index, (1, 1)) for index in range(12)}
    assert judge_sharpness(good) == {}
    assert set(judge_sharpness(good | {"v7": sharpness(7, blur)})) == {"v7"}
    assert judge_sharpness({name: [] for name in good}) == {}


def spoil(root: Path, made, name: str, factor: float) -> None:
    counts = made.reflectance[name] * made.white * factor + made.dark
    write_cube(root, name, np.rint(counts.clip(0, 4095)).astype(np.uint16))


@pytest.mark.usefixtures("contact_sheet")
def test_spoilt_views_are_left_out_and_spoil_nothing(tmp_path):
    made = make_capture(tmp_path / "capture", views=12)
    spoil(tmp_path / "capture", made, "view_03", 0.0)
    spoil(tmp_path / "capture", made, "view_06", 3.5)
    cut = tmp_path / "capture" / "view_08.raw"
    cut.write_bytes(cut.read_bytes()[:999])
    references = {key: tmp_path / "capture" / name for key, name in REFERENCES.items()}
    scene = tmp_path / "scene"
    wrong = process(tmp_path / "capture", scene, **references, leave_out=("view_10",))
    for name in ("view_03 is left out: it shows nothing", "view_06 is left out", "view_08 is left out, as"):
        assert sum(text.startswith(name) for text in wrong) == 1
    written = json.loads((scene / "transforms.json").read_text())
    assert {view["name"]: view["reason"] for view in written["left_out"]} == {
        "view_03": "black", "view_06": "overexposed", "view_08": "unreadable", "view_10": "not wanted",
    }  # fmt: skip
    names = [Path(frame["file_path"]).stem for frame in written["frames"]]
    assert names == [f"view_{index:02d}" for index in (0, 1, 2, 4, 5, 7, 9, 11)]
    assert written["calibrated_value_of_1"] == 1.0
    for name in names:
        stored = np.load(scene / "cubes" / f"{name}.npy") / 65535
        np.testing.assert_allclose(stored, made.reflectance[name], atol=1e-3)
    assert "view_10 is left out, as --leave-out says" in (scene / "report.txt").read_text()
    wrong = process(tmp_path / "capture", tmp_path / "kept", **references, keep_view=("view_06",))
    assert not any(text.startswith("view_06 is left out") for text in wrong)
    kept = json.loads((tmp_path / "kept" / "transforms.json").read_text())
    assert "view_06" in {Path(frame["file_path"]).stem for frame in kept["frames"]}
    assert kept["calibrated_value_of_1"] == 1.0  # which no single view decides


def test_views_are_named_by_those_that_are_there(tmp_path):
    make_capture(tmp_path / "capture")
    for option in ("leave_out", "keep_view"):
        with pytest.raises(ConfigError, match="view_1: no view of this name"):
            process(tmp_path / "capture", tmp_path / "scene", **{option: ("view_1",)})


@pytest.mark.parametrize("count", [1, 3])
def test_files_that_can_not_be_read_stop_the_command_where_they_are_no_exception(tmp_path, count):
    make_capture(tmp_path / "capture", views=4 if count == 1 else 8)
    for index in range(count):
        (tmp_path / "capture" / f"view_{index:02d}.raw").write_bytes(b"")
    with pytest.raises(CaptureError, match="view_0"):
        process(tmp_path / "capture", tmp_path / "scene")


def test_the_scale_does_not_follow_one_view(tmp_path):
    """Of floating-point radiance, which has no end; the bright view is too unlike the others to be another exposure."""
    root = tmp_path / "capture"
    make_capture(root, views=8, kind="npy")
    generator = np.random.default_rng(1)
    for index in range(8):
        values = generator.uniform(100.0, 1000.0, (HEIGHT, WIDTH, BANDS)).astype(np.float32)
        values[:4] *= 40 if index == 5 else 1
        np.save(root / f"view_{index:02d}.npy", values)
    centres = ",".join(str(500 + 10 * index) for index in range(BANDS))
    process(root, tmp_path / "scene", wavelengths=centres)
    written = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    assert written["calibrated_value_of_1"] == pytest.approx(1.02 * 1000.0, rel=0.01)  # with headroom
