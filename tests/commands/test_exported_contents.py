"""What is in the products that `unmix-export` writes: the model's numbers, the page, spectra of a place, the report."""

import base64
import csv
import gzip
import json
import re
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData

from tests.commands.conftest import export_words as words
from tests.commands.running import done, picture_size, refused, run
from tests.engine.conftest import registered, short_config  # noqa: F401 (fixtures)
from tests.products.mesh_reading import loaded_mesh
from tests.products.report.page_outline import assert_self_contained
from unmix_plugin.commands.export import export
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.formats.envi import read_header
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.trained.measures import keep_region
from unmix_plugin.trained.open_run import load_run
from unmix_plugin.trained.regions import Box
from unmix_plugin.trained.surface_mesh import TriangleMesh, vertex_areas


def test_files_hold_what_the_model_renders(solid, exported):
    root, loaded = exported[0], load_run(solid.run, "cpu")
    for index, name in enumerate(["eval_002", "eval_006"]):
        camera = loaded.record.eval_cameras[index]
        expected = loaded.scene.render(camera, ["spectral", "abundances", "segmentation"])
        np.testing.assert_array_equal(np.load(root / "cubes" / f"{name}.npy"), expected["spectral"])
        np.testing.assert_array_equal(np.load(root / "abundances" / f"{name}.npy"), expected["abundances"])
        ids = np.asarray(Image.open(root / "segmentation" / "labels" / f"{name}.png"))
        np.testing.assert_array_equal(ids, expected["segmentation"])
    endmembers = (root / "endmembers" / "endmembers.csv").read_bytes()
    assert endmembers == (solid.run / "endmembers.csv").read_bytes()


def test_points_and_mesh_lie_where_the_scene_is(solid, exported):
    scene = load_scene(solid.scene, SceneOptions())
    corners = scene.normalisation.to_world(scene.scene_box.aabb.numpy())
    low, high = corners.min(axis=0) - 0.2, corners.max(axis=0) + 0.2
    points = PlyData.read(exported[0] / "point-cloud" / "points.ply")["vertex"]
    vertices = [np.stack([points[axis] for axis in "xyz"], axis=1)]
    meshes = [exported[0] / "mesh" / f"mesh.{kind}" for kind in ("ply", "obj", "glb")]
    vertices += [loaded_mesh(path).vertices for path in meshes]
    assert 100 < len(vertices[0]) <= 500
    assert all(((low <= one) & (one <= high)).all() for one in vertices)
    for name in ("mesh", "splats"):
        said = " ".join(exported[1][name].split())
        assert f"lengths in {name}.glb are in units of the scene, of unknown size" in said


def test_splats_are_flat_upright_and_as_dense_as_the_surface(exported):
    ply = PlyData.read(exported[0] / "splats" / "splats.ply")["vertex"]
    content = json_of(exported[0] / "splats" / "splats.glb")
    primitive = content["meshes"][0]["primitives"][0]
    assert (primitive["mode"], content["extensionsUsed"]) == (0, ["KHR_gaussian_splatting"])
    assert content["accessors"][primitive["attributes"]["POSITION"]]["count"] == len(ply["x"])
    sizes = np.exp(np.stack([ply[f"scale_{axis}"] for axis in range(3)], axis=1))
    np.testing.assert_allclose(sizes[:, 2] / sizes[:, 0], 0.1, rtol=1e-4)
    # As many as cover the surface of the mesh of the same resolution, neighbours overlapping by half.
    mesh = loaded_mesh(exported[0] / "mesh" / "mesh.ply")
    assert (sizes[:, 0] ** 2).sum() == pytest.approx(0.75**2 * mesh.area, rel=0.02)
    # The third axis is the normal, and the scene's up, +z, is -y.
    w, x, y, z = (ply[f"rot_{index}"] for index in range(4))
    normals = PlyData.read(exported[0] / "mesh" / "mesh.ply")["vertex"]["nz"]
    np.testing.assert_allclose(2 * (y * z - x * w), -normals, atol=1e-4)


def json_of(path):
    """The JSON part of a GLB."""
    data = path.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def test_a_page_holds_the_surface_and_escapes_its_title(exported):
    page = (exported[0] / "page" / "page.html").read_text()
    assert page.count("<b>") == 0
    facts = json.loads(page.split('id="data-facts">')[1].split("</script>")[0])
    assert facts["title"] == "pots </script><b>"
    data = gzip.decompress(base64.b64decode(page.split('id="data-arrays">')[1].split("<")[0]))
    layout = facts["arrays"]
    stored = {
        name: np.frombuffer(data, how["type"], how["count"], how["start"]) for name, how in layout.items()
    }
    mesh, place = loaded_mesh(exported[0] / "mesh" / "mesh.ply"), layout["positions"]
    found = stored["positions"].reshape(-1, 3) * place["scale"] + place["offset"]
    np.testing.assert_allclose(found, mesh.vertices, atol=0.6 * place["scale"])
    np.testing.assert_array_equal(np.cumsum(stored["faces"]).reshape(-1, 3), mesh.faces)
    sheet = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    expected = vertex_areas(sheet.areas(), sheet.faces, len(sheet.vertices))
    np.testing.assert_allclose(stored["areas"], expected, rtol=1e-5)
    shares = layout["abundances"]["scale"] * (stored["abundances"].reshape(-1, 6) / 1.0) ** 2
    np.testing.assert_allclose(shares.sum(axis=1), 1, atol=0.03)
    assert "https://" not in page.split("<body>")[0]


def test_a_pixel_has_what_was_measured_there_beside_what_is_predicted(solid, exported):
    scene = load_scene(solid.scene, SceneOptions())
    index = [frame.name for frame in scene.frames].index("eval_002")
    base = exported[0] / "spectrum" / "eval_002_x8_y8"
    with base.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    measured = [float(row["measured"]) for row in rows]
    np.testing.assert_allclose(measured, scene.cube(index)[8, 8], rtol=1e-7)
    for row in rows:
        parts = float(row["diffuse"]) + float(row["specular"])
        assert float(row["predicted"]) == pytest.approx(parts, abs=1e-6)
    facts = json.loads(base.with_suffix(".json").read_text())
    assert (facts["view"], facts["pixel"]) == ("eval_002", [8, 8])
    assert sum(facts["abundances"].values()) == pytest.approx(1, abs=1e-4)
    assert facts["material"] == max(facts["abundances"], key=facts["abundances"].get)
    assert len(facts["library"]) == 3
    assert min(picture_size(base.with_suffix(".png"))) > 300


def test_a_pixel_without_a_valid_value_has_no_measured_spectrum(solid, tmp_path, monkeypatch):
    valid = np.ones((16, 16), bool)
    valid[9, 8] = False
    monkeypatch.setattr("unmix_plugin.scenes.scene.Scene.valid_mask", lambda _, __, part: valid[part])
    common = ["spectrum", "--view", "eval_002", "--run", solid.run, "--output", tmp_path]
    heads = {}
    for pixel, is_said in (("8,8", False), ("8,9", True)):
        said = " ".join(done(export, *common, "--pixel", pixel).out.split())
        assert ("no valid value in that pixel, or its mask leaves it out: no measured" in said) is is_said
        file = tmp_path / f"eval_002_x8_y{pixel[-1]}.csv"
        heads[pixel] = file.read_text().splitlines()[0].split(",")
    assert heads["8,8"] == [*heads["8,9"], "measured"]


def test_a_place_has_mean_and_spread_of_what_the_views_measured_that_see_it(solid, tmp_path, monkeypatch):
    place = ["spectrum", "--view", 0, "--pixel", "8,8"]
    words = [*place, "--run", solid.run, "--output", tmp_path, "--overwrite"]
    assert "fewer than two training views see the place" in run(export, *words).out  # only the hull stands
    monkeypatch.setattr("unmix_plugin.products.spectrum._SAME_PLACE_PX", np.inf)
    monkeypatch.setattr("unmix_plugin.products.spectrum._WHOLE", 0.0)
    done(export, *words)
    loaded, scene = load_run(solid.run, "cpu"), load_scene(solid.scene, SceneOptions())
    facts = json.loads((tmp_path / "eval_002_x8_y8.json").read_text())
    place = torch.from_numpy(loaded.scene.frame.to_model(np.array(facts["world_position"]))).float()
    spectra = []
    for row, index in enumerate(scene.train_indices):
        coords, depths = loaded.record.train_cameras.project(place[None], row)
        x, y = coords[0].floor().long().tolist()
        if depths[0] > 0 and 0 <= x < 16 and 0 <= y < 16:
            spectra.append(scene.cube(index)[y, x].astype(float))
    assert facts["measured_in_views"] == len(spectra) >= 2
    with (tmp_path / "eval_002_x8_y8.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = [[float(row[f"{name} over views"]) for row in rows] for name in ("mean", "standard deviation")]
    np.testing.assert_allclose(found, [np.mean(spectra, axis=0), np.std(spectra, axis=0, ddof=1)], atol=1e-6)


def test_a_point_goes_by_its_coordinates(solid, tmp_path):
    point = ["--point", "-0.0,0.05,0.2", "--run", solid.run, "--output", tmp_path, "--device", "cpu"]
    done(export, "spectrum", *point)
    with (tmp_path / "point_0_0.05_0.2.csv").open() as file:
        assert next(csv.reader(file)) == ["wavelength", "predicted"]


def test_own_reflectances_are_compared_with_too(solid, tmp_path):
    wavelengths = load_run(solid.run, "cpu").record.metadata["wavelengths_nm"]
    lines = [f"{wavelength},{0.1 + 0.05 * index}" for index, wavelength in enumerate(wavelengths)]
    (tmp_path / "mine.csv").write_text("\n".join(["wavelength,my very own", *lines]))
    common = ["--run", solid.run, "--output", tmp_path / "out", "--device", "cpu"]
    common += ["--library", tmp_path / "mine.csv", "+builtin"]
    done(export, "spectrum", "--view", 0, "--pixel", "8,8", "--compare", "continuum", *common)
    done(export, "report", "--max-views", 1, *common)
    assert "175 known" in (tmp_path / "out" / "report.html").read_text()
    common[-1] = tmp_path / "none.csv"
    assert "none.csv: can't read" in refused(export, "spectrum", "--view", 0, "--pixel", "9,9", *common)


def test_a_report_with_the_find_scene_compares_and_is_self_contained(exported):
    page = (exported[0] / "report" / "report.html").read_text()
    outline = assert_self_contained(page)
    ids = "scene views materials abundances segmentation figures error worst settings versions"
    assert outline.ids == ids.split()
    for text in (
        r"Rendered: 1 of 2 evaluation views\.",
        r"Of the 1 views rendered for this report\.",
        "intersection over union",
        r"6 materials told apart in 6 views: endmember_\d \(\d+% of what is seen",
        r"estimated probability of \d+% on average",
        "num_endmembers",
    ):
        assert re.search(text, outline.text), text


def test_a_report_keeps_what_it_is_about_with_the_run(solid_copy):
    given = ["--title", "Panel <A>", "--author", "A. Nobody", "--object", "icon"]
    given += ["--notes", "found in 1931\nwaxed"]
    done(export, *words("report", "--run", solid_copy, *given, "--number", "12.7"))
    done(export, *words("report", "--run", solid_copy, "--overwrite", "--number", ""))
    page = (solid_copy / "exports" / "report" / "report.html").read_text()
    assert "<h1>Panel &lt;A&gt;</h1>" in page
    assert all(text in page for text in ("A. Nobody", "icon", "found in 1931\nwaxed"))
    assert "12.7" not in page
    kept = solid_copy / "report.json"
    kept.write_text(kept.read_text().replace('"icon"', "[1]"))
    assert "report.json is damaged" in refused(export, *words("report", "--run", solid_copy, "--overwrite"))


def test_regions_that_are_kept_are_written_and_a_report_shows_them_and_says_which_it_cannot(solid_copy):
    names = load_run(solid_copy, "cpu").materials_scene.materials.names
    far = Box((90.0, 90.0, 90.0), (91.0, 91.0, 91.0))
    everything = Box((-90.0, -90.0, -90.0), (90.0, 90.0, 90.0))
    for name, region in (("all of it", everything), ("far away", far)):
        keep_region(RunFolder(solid_copy), name, region)
    done(export, *words("regions", "--run", solid_copy))
    done(export, "spectrum", "--region", "all of it", "--run", solid_copy, "--device", "cpu")
    quantity = load_run(solid_copy, "cpu").materials_scene.materials.quantity
    for file, about in (
        ("regions/regions.hdr", "mean spectra of regions"),
        ("spectrum/region_all of it.hdr", "mean spectrum"),
    ):
        header = read_header(solid_copy / "exports" / file)
        assert header["description"].strip() == f"{about}: {quantity}, 1 = full scale"
    done(export, *words("report", "--run", solid_copy))
    page = (solid_copy / "exports" / "report" / "report.html").read_text()
    assert_self_contained(page)
    section = page.partition('<section id="regions">')[2].partition("</section>")[0]
    assert re.search(r"<h3>all of it <span class=.note.>[0-9.]+ square units", section)
    assert "mean spectrum of the region all of it" in section
    shares = [float(share) for share in re.findall(r'<td class="number">([0-9.]+)</td>', section)]
    assert (len(shares), sum(shares)) == (len(names), pytest.approx(1, abs=0.01))
    assert "Not shown: the region far away has nothing of the surface in it" in page
    assert "far away" not in section


def test_a_report_quotes_the_figures_that_eval_found_and_links_to_the_page(solid_copy, tmp_path, monkeypatch):
    (solid_copy / "eval").mkdir()
    (solid_copy / "eval" / "metrics.json").write_text('{"psnr": 12.34, "miou": null, "definitions": {}}')
    (solid_copy / "exports" / "page").mkdir(parents=True)
    (solid_copy / "exports" / "page" / "page.html").touch()
    moved, out = solid_copy.rename(tmp_path / "50 % #1"), ["--output", tmp_path / "out", "--overwrite"]
    done(export, *words("report", "--run", moved, *out))
    page = (tmp_path / "out" / "report.html").read_text()
    assert '<a href="../50%20%25%20%231/exports/page/page.html">in 3-D</a>' in page
    assert "eval/metrics.json" in page
    assert "12.34" in page
    (moved / "eval" / "metrics.json").write_text('{"psnr": 12.34, "train_seconds": 1e-9, "definitions": {}}')
    ended = done(export, *words("report", "--run", moved, *out))
    assert "metrics.json is of an earlier state of the run, and left out" in ended.out
    assert "12.34" not in (tmp_path / "out" / "report.html").read_text()
    # On Windows, there is no relative path to another drive.
    monkeypatch.setattr("os.path.relpath", Mock(side_effect=ValueError("path is on mount 'C:'")))
    done(export, *words("report", "--run", moved, *out))
    assert "in 3-D" not in (tmp_path / "out" / "report.html").read_text()
