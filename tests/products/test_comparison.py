"""Runs side by side: differences by view and band, what is left out, and what is refused."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from unmix_plugin.errors import ConfigError
from unmix_plugin.products.comparison import ComparedRun, compare_runs
from unmix_plugin.trained.evaluation import BandErrors

NM = np.array([450.0, 550.0, 650.0])


def view(mse, nm=NM, mean=(0.1, 0.2, 0.3)):
    return BandErrors(nm, np.array(mean)[: len(nm)], np.array(mse), 64)


def compared(folder, name, psnr, views, setting=4):
    pictures = folder / name / "eval"
    (pictures / "rgb").mkdir(parents=True, exist_ok=True)
    for one in views:
        Image.new("RGB", (30, 20), "red").save(pictures / "rgb" / f"{one}.png")
    per_view = {one: {"name": one, "psnr": psnr} for one in views}
    found = ({"psnr": psnr, "miou": None}, per_view, views, np.zeros((len(views), 3, 4)))
    return ComparedRun(folder / name, "unmix-nerf", *found, pictures, {"endmembers": setting, "seed": 42})


def rows_of(path):
    return list(csv.reader(path.read_text().splitlines()))


def test_figures_settings_and_errors_stand_side_by_side_with_differences(tmp_path):
    first = compared(tmp_path, "a", 30.0, {"v0": view([0.04, 0.01, 0.01]), "v1": view([0.01, 0.01, 0.01])})
    other = compared(tmp_path, "b", 31.5, {"v0": view([0.01, 0.01, 0.04]), "v1": view([0.01, 0.01, 0.01])}, 6)
    found = compare_runs([first, other], tmp_path / "out")
    assert found.labels == ["a", "b"]
    assert found.rows == [("endmembers", [4, 6]), ("psnr", [30.0, 31.5])]
    assert found.remarks == []
    assert rows_of(tmp_path / "out" / "views.csv")[1] == ["v0", "psnr", "30", "31.5", "+1.5"]
    bands = rows_of(tmp_path / "out" / "band_rmse.csv")
    assert bands[0] == ["view", "wavelength_nm", "a", "b", "b minus a"]
    assert bands[1] == ["v0", "450", "0.2", "0.1", "-0.1"]
    assert len(bands) == 1 + 2 * 3
    with Image.open(tmp_path / "out" / "rgb" / "v1.png") as picture:
        assert picture.size == (30, 120)
        assert picture.getpixel((29, 59)) == picture.getpixel((29, 119)) == (255, 0, 0)
    assert found.num_pictures == 2


def test_runs_that_share_part_of_bands_and_views_are_compared_on_that_part_and_say_so(tmp_path):
    first = compared(tmp_path, "a", 30.0, {"v0": view([0.01, 0.04, 1.0]), "v1": view([1.0, 1.0, 1.0])})
    other = compared(tmp_path, "b", 10.0, {"v0": view([0.01, 0.01], NM[:2])})
    found = compare_runs([first, other], tmp_path / "out")
    figures = dict(found.rows)
    assert figures["rmse"] == pytest.approx([0.025**0.5, 0.1])
    assert figures["psnr"] == pytest.approx([16.0206, 20.0], abs=1e-4)
    assert len(rows_of(tmp_path / "out" / "band_rmse.csv")) == 3
    assert "left out: 1 view that not all runs have" in found.remarks
    assert "of what they share alone, 1 view and 2 bands" in found.remarks[-1]


def test_views_without_a_shared_band_or_a_valid_pixel_are_left_out_and_said(tmp_path):
    whole, blank = view([0.01, 0.01, 0.01]), BandErrors(NM, np.full(3, np.nan), np.full(3, np.nan), 0)
    infrared = view([1.0, 1.0, 1.0], NM + 500)
    first = compared(tmp_path, "a", 30.0, {"v0": whole, "v1": whole, "v2": blank})
    again = compared(tmp_path, "b", 31.0, {"v0": whole, "v1": whole, "v2": blank})
    found = compare_runs([first, again], tmp_path / "out")
    assert found.rows == [("psnr", [30.0, 31.0])]
    assert found.remarks == ["left out: 1 view without a valid pixel"]
    other = compared(tmp_path, "c", 31.0, {"v0": whole, "v1": infrared, "v2": whole})
    found = compare_runs([first, other], tmp_path / "out")
    assert dict(found.rows) == {"psnr": pytest.approx([20.0, 20.0]), "rmse": pytest.approx([0.1, 0.1])}
    assert "left out: 1 view without a shared band" in found.remarks
    assert found.remarks[-1].endswith("1 view and 3 bands")
    with pytest.raises(ConfigError, match="b: no evaluation view has a valid pixel"):
        compare_runs([first, compared(tmp_path, "b", 31.0, {"v0": blank})], tmp_path / "out")


def test_runs_that_share_nothing_are_refused(tmp_path):
    first = compared(tmp_path, "a", 30.0, {"v0": view([0.01, 0.01, 0.01])})
    brighter = compared(tmp_path, "b", 30.0, {"v0": view([0.01, 0.01, 0.01], mean=(0.2, 0.4, 0.6))})
    with pytest.raises(ConfigError, match="runs of different scenes: no evaluation view shows the same"):
        compare_runs([first, brighter], tmp_path / "out")
    infrared = compared(tmp_path, "c", 30.0, {"v0": view([0.01, 0.01, 0.01], NM + 500)})
    with pytest.raises(ConfigError, match="the runs share no band"):
        compare_runs([first, infrared], tmp_path / "out")
    of_objects = replace(first, path=tmp_path / "d", bands={}, method="neumatex")
    with pytest.raises(ConfigError, match=r"of unmix-nerf, .* of neumatex: these measure .*; compare runs"):
        compare_runs([first, of_objects], tmp_path / "out")
    moved = replace(of_objects, path=tmp_path / "e", cameras=np.ones((1, 3, 4)))
    with pytest.raises(ConfigError, match="runs of different scenes"):
        compare_runs([of_objects, moved], tmp_path / "out")
    assert not (tmp_path / "out").exists()
