"""Files of views, places and cameras: endmembers, labels, spectra and poses, read back with other people's readers."""

import csv
import json
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenEXR
import pytest
import spectral.io.envi as envi
import torch
from PIL import Image
from torch.testing import assert_close

from tests.method_factory import make_scene
from tests.scenes import scene_factory
from tests.trained.camera_scenes import FRAME, around
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.processes import ALONE
from unmix_plugin.products import views
from unmix_plugin.products.endmembers import _endmember_paths, _write_endmembers
from unmix_plugin.products.poses import _poses_json
from unmix_plugin.products.product import Job, Product
from unmix_plugin.products.scene_products import Abundances, Cubes, Segmentation
from unmix_plugin.products.spectrum import _facts, _ProbedPlace
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.trained.camera_files import read_camera_file
from unmix_plugin.trained.places import MeasuredScene, SeenPixel
from unmix_plugin.trained.run_views import RunView

SCENE = make_scene()
MATERIALS = SCENE.materials


def job_of(scene, folder, say=lambda _: None):
    """A job on a scene, of which nothing else is known."""
    loaded: Any = SimpleNamespace(materials_scene=scene, scene=scene, record=SimpleNamespace(summary={}))
    quiet = (say, lambda _: nullcontext(), lambda _, items: iter(items))
    return Job(loaded, folder, False, *quiet, ALONE)


def test_spectral_python_opens_the_endmembers_as_a_library(tmp_path):
    _write_endmembers(tmp_path, MATERIALS)
    assert sorted(tmp_path.glob("[!.]*")) == sorted(_endmember_paths(tmp_path))
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
    views.segmentation(job_of(SCENE, tmp_path), Segmentation())
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


def test_a_product_is_named_for_its_class_unless_it_has_a_name():
    class FlatMap(Product):
        pass

    class Chart(Product):
        name = "reflectance-chart"

    assert (FlatMap.name, Chart.name) == ("flat-map", "reflectance-chart")


@pytest.mark.parametrize(
    ("product", "said"),
    [
        (Abundances(formats=("envi", "exr")), "abundances, summing to the opacity"),
        (Cubes(formats=("envi", "exr")), "radiance on black, 1 = full scale"),
    ],
)
def test_cubes_say_of_which_view_their_numbers_are(tmp_path, product, said):
    product.write(job_of(SCENE, tmp_path))
    name = next(view.name for view in SCENE.views if view.split == "eval")
    image: Any = envi.open(str(tmp_path / f"{name}.hdr"))
    assert image.metadata["description"] == f"{name}: {said}"
    assert OpenEXR.File(str(tmp_path / f"{name}.exr")).header()["comments"] == f"{name}: {said}"


def test_what_a_training_view_measured_is_as_exposed_as_the_trained_scene(tmp_path):
    scene = load_scene(scene_factory.make_scene(tmp_path / "ball").root)
    gains = torch.rand(len(scene.train_indices), len(scene.wavelengths_nm)) + 0.5
    trained, measured = replace(make_scene(), view_gains=gains), MeasuredScene(scene, None)
    row, column = np.argwhere(scene.cube(0).sum(axis=-1) > 0)[0].tolist()
    for number, index in enumerate(scene.train_indices):
        expected = scene.cube(index)[row, column] / gains[number].numpy()
        np.testing.assert_allclose(
            measured.spectrum(SeenPixel(index, column, row), trained), expected, rtol=1e-5
        )
    index = scene.eval_indices[0]
    as_exposed = measured.spectrum(SeenPixel(index, column, row), trained)
    assert as_exposed.tolist() == scene.cube(index)[row, column].tolist()


def test_poses_are_in_world_space_of_frame_cameras_as_a_camera_file_and_of_line_cameras_by_row(tmp_path):
    pose = torch.tensor([[[0.0, 0, 1, 2.0], [1, 0, 0, 0.5], [0, 1, 0, 0.1]]])
    lens = (torch.tensor([[20.0, 21.0]]), torch.tensor([[6.0, 5.0]]), torch.tensor([[0.1, 0.0, 0.0, 0.0]]))
    camera = Cameras(pose, *lens, 12, 10)
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(_poses_json([RunView("a", camera, "train")], FRAME, True)))
    [found] = read_camera_file(path, FRAME).views
    assert found.name == "a"
    for name in ("camera_to_world", "focal_px", "distortion"):
        assert_close(getattr(found.camera, name), getattr(camera, name), atol=1e-6, rtol=0)
    assert json.loads(path.read_text())["poses_refined"] is True
    lines = replace(camera, key_poses=KeyPoses(pose.repeat(2, 1, 1), torch.tensor([0.5, 9.5]), (2,)))
    entry = _poses_json([RunView("a", lines)], FRAME, False)["frames"][0]
    assert "transform_matrix" not in entry
    assert [key["row"] for key in entry["key_poses"]] == [0.0, 9.0]
    matrix = np.array(entry["key_poses"][1]["transform_matrix"])
    np.testing.assert_allclose(FRAME.to_model(matrix[:3, 3]), pose[0, :, 3], atol=1e-6)
    np.testing.assert_allclose(FRAME.rotation @ matrix[:3, :3], pose[0, :, :3], atol=1e-6)
