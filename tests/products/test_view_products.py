"""Endmembers and ids of views in other people's formats, read back with their readers."""

import csv
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import spectral.io.envi as envi
from PIL import Image

from tests.method_factory import make_scene
from tests.trained.camera_scenes import around
from unmix_plugin.engine.processes import ALONE
from unmix_plugin.products import views
from unmix_plugin.products.endmembers import _endmember_paths, _write_endmembers
from unmix_plugin.products.product import Job
from unmix_plugin.products.scene_products import Segmentation
from unmix_plugin.products.spectrum import _facts, _ProbedPlace

SCENE = make_scene()
MATERIALS = SCENE.materials


def test_spectral_python_opens_the_endmembers_as_a_library(tmp_path):
    _write_endmembers(tmp_path, MATERIALS)
    assert sorted(tmp_path.iterdir()) == sorted(_endmember_paths(tmp_path))
    library: Any = envi.open(str(tmp_path / "endmembers.hdr"), str(tmp_path / "endmembers.sli"))
    assert library.names == list(MATERIALS.names)
    np.testing.assert_array_equal(library.spectra, MATERIALS.endmembers.numpy())
    np.testing.assert_array_equal(library.bands.centers, MATERIALS.bands.centers_nm)


@pytest.mark.parametrize("method", ["abundances", "probe"])
def test_the_material_of_a_pixel_is_that_of_its_label(method):
    scene = replace(SCENE, materials=replace(MATERIALS, segmentation=method))
    camera = around()[0]
    ids = scene.look(camera)["segmentation"]
    for row, column in (ids < 255).nonzero()[::40].tolist():
        place = _ProbedPlace("", "", {}, scene.probe(camera, column, row))
        assert _facts(place, scene.materials)["material"] == MATERIALS.names[int(ids[row, column])]


def test_labels_are_ids_whose_palette_and_legend_name_the_materials(tmp_path):
    quiet = (lambda _: None, lambda _: nullcontext(), lambda _, items: iter(items))
    job = Job(
        cast("Any", SimpleNamespace(materials_scene=SCENE, scene=SCENE)), tmp_path, False, *quiet, ALONE
    )
    views.segmentation(job, Segmentation())
    view = next(view for view in SCENE.views if view.split == "eval")
    with Image.open(tmp_path / "labels" / f"{view.name}.png") as labels:
        ids, colours = np.asarray(labels), np.asarray(labels.convert("RGB"))
        assert labels.mode == "P"
    np.testing.assert_array_equal(ids, SCENE.look(view.camera)["segmentation"])
    assert len(np.unique(ids)) > 2
    rows = {int(row["id"]): row for row in csv.DictReader((tmp_path / "legend.csv").read_text().splitlines())}
    assert [rows[index]["name"] for index in (0, 1, 2, 255)] == [*MATERIALS.names, "nothing"]
    for index in np.unique(ids):
        expected = [int(rows[int(index)][name]) for name in ("red", "green", "blue")]
        assert (colours[ids == index] == expected).all()
