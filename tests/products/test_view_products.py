"""Files of views, places and cameras: endmembers, labels, spectra and poses, read back with other people's readers."""

import csv
import json
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import OpenEXR
import pycolmap
import pytest
import spectral.io.envi as envi
import torch
from PIL import Image
from torch.testing import assert_close

from tests.factories import scenes
from tests.factories.cameras import FRAME, around
from tests.factories.models import around_endmembers, make_scene
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.geometry.key_poses import KeyPoses
from unmix_plugin.engine.processes import ALONE
from unmix_plugin.products import views
from unmix_plugin.products.endmembers import write_endmembers
from unmix_plugin.products.poses import export as export_poses
from unmix_plugin.products.product import Job, Product
from unmix_plugin.products.scene_products import Abundances, Cubes, Poses, Segmentation
from unmix_plugin.products.spectrum import ProbedPlace, place_facts
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
    write_endmembers(tmp_path, MATERIALS, around_endmembers(MATERIALS))
    kinds = (".csv", "-intervals.csv", ".hdr", ".sli", ".png")
    assert sorted(path.name for path in tmp_path.glob("[!.]*")) == sorted(
        f"endmembers{kind}" for kind in kinds
    )
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
        place = ProbedPlace("", "", {}, scene.probe(camera, column, row))
        assert place_facts(place, scene.materials)["material"] == MATERIALS.names[int(ids[row, column])]


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
    scene = load_scene(scenes.make_scene(tmp_path / "ball").root)
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


def export_views(views, folder, root=None, said=None):
    """The content of transforms.json that the product writes for these views."""
    scene = SimpleNamespace(views=views, frame=FRAME, fitted=("pose",))
    loaded: Any = SimpleNamespace(
        scene=scene, scale=None, record=SimpleNamespace(summary={"root": str(root or "")})
    )
    quiet = (lambda _: nullcontext(), lambda _, items: iter(items))
    export_poses(Job(loaded, folder, False, ([] if said is None else said).append, *quiet, ALONE), Poses())
    return json.loads((folder / "transforms.json").read_text())


POSE = torch.tensor([[[0.0, 0, 1, 2.0], [1, 0, 0, 0.5], [0, 1, 0, 0.1]]])
LENS = (torch.tensor([[20.0, 21.0]]), torch.tensor([[6.0, 5.0]]), torch.tensor([[0.1, 0.0, 0.0, 0.0]]))


def test_poses_are_in_world_space_of_frame_cameras_as_a_camera_file_and_of_line_cameras_by_row(tmp_path):
    camera = Cameras(POSE, *LENS, 12, 10)
    content = export_views([RunView("a", camera, "train")], tmp_path / "frames")
    [found] = read_camera_file(tmp_path / "frames" / "transforms.json", FRAME).views
    assert found.name == "a"
    for name in ("camera_to_world", "focal_px", "distortion"):
        assert_close(getattr(found.camera, name), getattr(camera, name), atol=1e-6, rtol=0)
    assert content["poses_refined"] is True
    lines = replace(camera, key_poses=KeyPoses(POSE.repeat(2, 1, 1), torch.tensor([0.5, 9.5]), (2,)))
    said: list[str] = []
    entry = export_views([RunView("a", lines)], tmp_path / "lines", said=said)["frames"][0]
    assert "transform_matrix" not in entry
    assert [key["row"] for key in entry["key_poses"]] == [0.0, 9.0]
    matrix = np.array(entry["key_poses"][1]["transform_matrix"])
    np.testing.assert_allclose(FRAME.to_model(matrix[:3, 3]), POSE[0, :, 3], atol=1e-6)
    np.testing.assert_allclose(FRAME.rotation @ matrix[:3, :3], POSE[0, :, :3], atol=1e-6)
    assert any("line cameras: 1 of 1 views" in line for line in said)


@pytest.mark.parametrize(
    "terms", [[0.0] * 4, [0.1, -0.02, 0.003, -0.004], [0.1, -0.02, 0.003, -0.004, 0.05, 0.0]]
)
def test_colmap_and_nerfstudio_see_points_where_the_run_does(terms, tmp_path):
    focal, center, size = [20.0, 21.0], [6.5, 5.25], (12, 10)
    camera = Cameras(POSE, torch.tensor([focal]), torch.tensor([center]), torch.tensor([terms]), *size)
    (tmp_path / "scene/images").mkdir(parents=True)
    for name in ("a", "b"):
        Image.new("RGB", size).save(tmp_path / f"scene/images/{name}.png")
    views = [
        RunView("a", camera, "train"),
        RunView("b", replace(camera, camera_to_world=POSE + 0.25 * (POSE == 2.0))),
    ]
    content = export_views(views, tmp_path / "out", tmp_path / "scene")
    x, y, z = ideal = np.random.default_rng(0).uniform([-0.2, -0.2, 1], [0.2, 0.2, 3], (9, 3)).T * [
        [1],
        [1],
        [1],
    ]
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = (*terms, 0.0)[:5]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = focal[0] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + center[0]
    v = focal[1] * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + center[1]
    model = pycolmap.Reconstruction(str(tmp_path / "out/sparse/0"))
    assert sorted(image.name for image in model.images.values()) == ["a.png", "b.png"]
    for frame, image in zip(
        content["frames"], sorted(model.images.values(), key=lambda one: one.name), strict=True
    ):
        assert (tmp_path / "out" / frame["file_path"]).is_file()
        assert (frame["w"], frame["h"], frame["fl_x"]) == (*size, focal[0])
        matrix = np.array(frame["transform_matrix"])
        world = matrix[:3, :3] @ (np.diag([1, -1, -1]) @ ideal) + matrix[:3, 3:]
        for point, expected in zip(world.T, np.stack([u, v], 1), strict=True):
            np.testing.assert_allclose(image.project_point(point), expected, atol=1e-4)
    assert (content["w"], content["fl_x"]) == (size[0], focal[0])


def test_pictures_that_are_no_longer_there_are_said_to_be_missing(tmp_path):
    said: list[str] = []
    export_views([RunView("a", Cameras(POSE, *LENS, 12, 10))], tmp_path / "out", tmp_path / "none", said)
    assert not (tmp_path / "out/images").exists()
    assert any("copy those of the scene to images/" in line for line in said)
