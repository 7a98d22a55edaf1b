"""`unmix-export`: what is written and refused, from a run alone, edited and relit; and products of methods."""

import base64
import csv
import gzip
import importlib.metadata
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import spectral.io.envi as envi
import torch
from PIL import Image
from plyfile import PlyData

from tests.commands.running import picture_size, run
from tests.engine.conftest import registered, short_config  # noqa: F401 (fixtures)
from tests.engine.stopped_runs import finished
from tests.formats.cubes import full_disk
from tests.products.mesh_reading import loaded_mesh
from tests.products.report.page_outline import assert_self_contained
from unmix_plugin.commands.export import PRODUCTS, export
from unmix_plugin.engine import registry
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.products.product import RunProduct
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv
from unmix_plugin.trained.measures import keep_region
from unmix_plugin.trained.open_run import load_run, open_run
from unmix_plugin.trained.regions import Box
from unmix_plugin.trained.surface_mesh import TriangleMesh, vertex_areas

SMALL = {
    "cubes": ["--formats", "envi", "exr", "npy"],
    "mesh": ["--formats", "ply", "obj", "glb", "--resolution", 24],
    "page": ["--resolution", 24, "--title", "pots </script><b>"],
    "point-cloud": ["--num-points", 500],
    "splats": ["--resolution", 24],
    "report": ["--max-views", 1],
    "spectrum": ["--view", "eval_002", "--pixel", "8,8"],
    "volume": ["--resolution", 8],
}
NAMES = [product.name for product in PRODUCTS if isinstance(product, RunProduct)]


def words(name, *more):
    return [name, *SMALL.get(name, []), "--device", "cpu", *more]


@pytest.fixture
def solid_copy(solid, tmp_path):
    """A copy of the run that a test may damage."""
    return Path(shutil.copytree(solid.run, tmp_path / "copy" / solid.run.name))


@pytest.fixture(scope="module")
def exported(solid, tmp_path_factory):
    """A folder of every product."""
    root = tmp_path_factory.mktemp("exported")
    said = {}
    for name in NAMES:
        ended = run(export, *words(name, "--run", solid.run, "--output", root / name))
        assert ended.status == 0, (name, ended.err)
        said[name] = ended.out
    return root, said


@pytest.fixture(scope="module")
def model_outputs(solid):
    """What the trained model renders of its evaluation views, by view name."""
    loaded = load_run(solid.run, "cpu")
    outputs = ["abundances", "accumulation", "segmentation"]
    found = {}
    for index, name in enumerate(["eval_002", "eval_006"]):
        rendered = loaded.scene.render(loaded.record.eval_cameras[index], outputs)
        found[name] = {key: value.numpy() for key, value in rendered.items()}
    return found


def test_abundances_are_the_models_and_sum_to_its_opacity(exported, model_outputs):
    folder = exported[0] / "abundances"
    for name, outputs in model_outputs.items():
        found = np.load(folder / f"{name}.npy")
        assert (found.dtype, found.shape) == (np.float32, (16, 16, 6))
        np.testing.assert_array_equal(found, outputs["abundances"])
        np.testing.assert_allclose(found.sum(axis=-1), outputs["accumulation"], atol=1e-5)
        assert min(picture_size(folder / f"{name}.png")) > 200
    names = [f"{name}.{kind}" for name in model_outputs for kind in ("npy", "png")]
    assert sorted(path.name for path in folder.iterdir()) == names


def test_segmentation_is_the_models_ids_their_scores_and_a_figure(exported, model_outputs):
    folder = exported[0] / "segmentation"
    for name, outputs in model_outputs.items():
        ids = np.asarray(Image.open(folder / "labels" / f"{name}.png"))
        scores = np.load(folder / f"{name}.npy")
        assert (ids.dtype, scores.dtype, scores.shape) == (np.uint8, np.float32, (16, 16, 6))
        np.testing.assert_array_equal(ids, outputs["segmentation"])
        seen = ids != 255
        np.testing.assert_array_equal(ids[seen], scores.argmax(axis=-1)[seen])
        np.testing.assert_array_equal(seen, outputs["accumulation"] >= 0.5)
        assert (folder / f"{name}.png").is_file()


def test_endmembers_are_those_of_the_run_as_csv_and_plot(solid, exported):
    folder = exported[0] / "endmembers"
    assert (folder / "endmembers.csv").read_bytes() == (solid.run / "endmembers.csv").read_bytes()
    assert read_spectra_csv(folder / "endmembers.csv").spectra.shape == (6, 8)
    assert min(picture_size(folder / "endmembers.png")) > 400


@pytest.mark.parametrize(("views", "count"), [("eval", 2), ("train", 6), ("all", 8)])
def test_views_are_chosen_by_split_and_named_as_the_frames(trained, tmp_path, views, count):
    ended = run(export, "abundances", "--run", trained.run, "--output", tmp_path, "--views", views)
    assert ended.status == 0, ended.err
    names = {path.stem for path in tmp_path.glob("*.npy")}
    frames = {path.stem for path in (trained.scene / "cubes").iterdir()}
    assert len(names) == count
    assert names == {name for name in frames if views == "all" or name.startswith(views)}


def test_without_run_the_newest_is_exported(run_copy, monkeypatch, tmp_path):
    shutil.move(run_copy.parents[2], tmp_path / "outputs")
    monkeypatch.chdir(tmp_path)
    ended = run(export, "endmembers")
    assert ended.status == 0, ended.err
    assert (
        tmp_path / "outputs/demo/unmix-nerf" / run_copy.name / "exports/endmembers/endmembers.csv"
    ).is_file()


@pytest.mark.parametrize("product", ["abundances", "segmentation"])
def test_a_full_disk_exits_2_says_where_and_leaves_no_part_of_a_file(trained, tmp_path, monkeypatch, product):
    full_disk(monkeypatch, after=0)
    ended = run(export, product, "--run", trained.run, "--output", tmp_path)
    assert ended.status == 2
    assert f"can't write {tmp_path / 'eval_002.npy'}: No space left on device" in ended.err
    assert "--load-run" not in ended.err
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_folder_that_cannot_be_made_exits_2(trained, tmp_path):
    (tmp_path / "file").write_text("in the way")
    ended = run(export, "endmembers", "--run", trained.run, "--output", tmp_path / "file" / "here")
    assert ended.status == 2
    assert str(tmp_path / "file" / "here") in ended.err


@pytest.mark.parametrize("words", [[], ["spectra"], ["abundances", "--views", "some"]])
def test_words_that_do_not_parse_exit_2(words):
    ended = run(export, *words)
    assert ended.status == 2
    assert ended.err


def entry(name, value):
    return importlib.metadata.EntryPoint(
        name, f"tests.commands.own_product_plugin:{value}", registry.METHOD_GROUP
    )


@pytest.fixture
def own(registered):  # noqa: F811
    registered[:] = [entry("rgb-nerf", "with_product")]
    return registered


@pytest.mark.usefixtures("own")
def test_a_product_of_a_method_is_listed_and_written_with_its_options(short_config, tmp_path):  # noqa: F811
    trainer = finished(short_config)
    assert "view-names" in run(export, "--help").out
    words = ["view-names", "--run", trainer.run.path, "--output", tmp_path / "out", "--device", "cpu"]
    ended = run(export, *words, "--capitals")
    assert ended.status == 0, ended.err
    names = (tmp_path / "out" / "names.txt").read_text().split()
    assert len(names) == 12
    assert names[0] == "EVAL_000"
    assert "--overwrite" in run(export, *words).err
    ended = run(export, *words, "--edits", "recipe.yml")
    assert ended.status == 2


def test_a_product_is_refused_for_runs_of_other_methods(own, trained, tmp_path):
    installed = importlib.metadata.EntryPoint(
        "unmix-nerf", "unmix_plugin.method_config:unmix_nerf", registry.METHOD_GROUP
    )
    own.append(installed)
    ended = run(export, "view-names", "--run", trained.run, "--output", tmp_path, "--device", "cpu")
    assert ended.status == 2
    assert "the method unmix-nerf has no product view-names: it needs a run of rgb-nerf" in " ".join(
        ended.err.split()
    )


def test_products_that_fail_or_whose_name_is_taken_are_skipped_and_said(own):
    own += [entry("rgb-2", "clashing"), entry("rgb-3", "broken")]
    ended = run(export, "--help")
    assert ended.status == 0
    assert "skipped the plugin rgb-2: another product has the name mesh already" in ended.err
    assert "skipped the plugin rgb-3: its products: ImportError: no module named scissors" in ended.err
    assert "view-names" in ended.out
    assert run(export, "mesh", "--help").out.count("--smoothing") > 0


def test_help_imports_neither_torch_nor_what_writes_products():
    code = (
        "import sys\nfrom unmix_plugin.commands.entry import run_command\n"
        "from unmix_plugin.commands.export import export\n"
        "for words in ['--help'], ['mesh', '--help']:\n"
        "    try:\n        run_command(export, words)\n"
        "    except SystemExit as stop:\n"
        "        heavy = {'torch', 'warp', 'scipy', 'skimage', 'matplotlib', 'PIL'}\n"
        "        print('end:', stop.code, sorted(heavy & set(sys.modules)))\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, errors="replace", check=True
    )
    assert ended.stdout.count("end: 0 []\n") == 2, ended.stdout


@pytest.mark.parametrize("name", NAMES)
def test_every_file_written_is_named_and_nothing_else_is_there(exported, name):
    root, said = exported
    files = sorted(str(path) for path in (root / name).rglob("*") if path.is_file())
    assert files
    lines = said[name].splitlines()
    assert sorted(line for line in lines if line.startswith(str(root))) == files
    assert lines[-1] == f"{len(files)} file{'s' if len(files) > 1 else ''} written to {root / name}"


@pytest.mark.parametrize("name", NAMES)
def test_no_file_is_replaced_unless_overwrite_is_given(solid, exported, tmp_path, name):
    copy = shutil.copytree(exported[0] / name, tmp_path / name)
    victim = sorted(path for path in copy.rglob("*") if path.is_file())[-1]
    for path in copy.rglob("*"):
        if path.is_file() and path != victim:
            path.unlink()
    victim.write_bytes(b"mine")
    ended = run(export, *words(name, "--run", solid.run, "--output", copy))
    assert ended.status == 2
    assert str(victim) in ended.err
    assert "--overwrite" in ended.err
    assert [path.read_bytes() for path in copy.rglob("*") if path.is_file()] == [b"mine"]
    assert run(export, *words(name, "--run", solid.run, "--output", copy, "--overwrite")).status == 0
    assert victim.read_bytes() != b"mine"


def test_every_product_comes_from_the_run_folder_alone(solid, solid_copy, tmp_path):
    shutil.move(solid.scene, tmp_path / "elsewhere")
    try:
        for name in NAMES:
            ended = run(export, *words(name, "--run", solid_copy))
            assert ended.status == 0, (name, ended.err)
            assert list((solid_copy / "exports" / name).iterdir())
    finally:
        shutil.move(tmp_path / "elsewhere", solid.scene)
    with (solid_copy / "exports/spectrum/eval_002_x8_y8.csv").open() as file:
        assert next(csv.reader(file)) == ["wavelength", "predicted", "diffuse", "specular"]
    page = (solid_copy / "exports/report/report.html").read_text()
    assert "Not evaluated: run unmix-eval" in page
    assert_self_contained(page)


def test_more_views_are_segmented_into_a_folder_with_the_same_legend(solid, tmp_path):
    common = ["--run", solid.run, "--output", tmp_path, "--device", "cpu"]
    assert run(export, "segmentation", *common).status == 0
    assert run(export, "segmentation", "--views", "train", *common).status == 0
    assert len(list((tmp_path / "labels").iterdir())) == 8
    (tmp_path / "legend.csv").write_text("mine")
    shutil.rmtree(tmp_path / "labels")
    for path in (*tmp_path.glob("*.npy"), *tmp_path.glob("*.png")):
        path.unlink()
    ended = run(export, "segmentation", *common)
    assert ended.status == 2
    assert "legend.csv exist" in ended.err


def test_cubes_are_what_the_model_renders(solid, exported):
    loaded = load_run(solid.run, "cpu")
    expected = loaded.scene.render(loaded.record.eval_cameras[0], ["spectral"])["spectral"]
    base = exported[0] / "cubes" / "eval_002"
    np.testing.assert_array_equal(np.load(f"{base}.npy"), expected)
    from_envi: Any = envi.open(f"{base}.hdr", f"{base}.img")
    np.testing.assert_array_equal(from_envi.open_memmap(), expected)


def test_points_and_mesh_lie_where_the_scene_is(solid, exported):
    scene = load_scene(solid.scene, SceneOptions())
    corners = scene.normalisation.to_world(scene.scene_box.aabb.numpy())
    low, high = corners.min(axis=0) - 1e-4, corners.max(axis=0) + 1e-4
    vertices = PlyData.read(exported[0] / "point-cloud" / "points.ply")["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    assert 100 < len(points) <= 500
    assert ((points >= low) & (points <= high)).all()
    for kind in ("ply", "obj", "glb"):
        mesh = loaded_mesh(exported[0] / "mesh" / f"mesh.{kind}")
        assert ((mesh.vertices >= low - 0.2) & (mesh.vertices <= high + 0.2)).all()
    for name, file in (("mesh", "mesh.glb"), ("splats", "splats.glb")):
        said = " ".join(exported[1][name].split())
        assert f"lengths in {file} are in units of the scene, of unknown size" in said


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
    arrays = gzip.decompress(base64.b64decode(page.split('id="data-arrays">')[1].split("<")[0]))
    how = facts["arrays"]["positions"]
    stored = np.frombuffer(arrays, "<u2", how["count"], how["start"]).reshape(-1, 3)
    mesh = loaded_mesh(exported[0] / "mesh" / "mesh.ply")
    found = stored * how["scale"] + how["offset"]
    np.testing.assert_allclose(found, mesh.vertices, atol=0.6 * how["scale"])
    how = facts["arrays"]["faces"]
    corners = np.cumsum(np.frombuffer(arrays, "<i4", how["count"], how["start"]))
    np.testing.assert_array_equal(corners.reshape(-1, 3), mesh.faces)
    how = facts["arrays"]["areas"]
    areas = np.frombuffer(arrays, "<f4", how["count"], how["start"])
    sheet = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    expected = vertex_areas(sheet.areas(), sheet.faces, len(sheet.vertices))
    np.testing.assert_allclose(areas, expected, rtol=1e-5)
    how = facts["arrays"]["abundances"]
    roots = np.frombuffer(arrays, "u1", how["count"], how["start"]).reshape(-1, 6) / 1.0
    np.testing.assert_allclose((how["scale"] * roots**2).sum(axis=1), 1, atol=0.03)
    assert "https://" not in page.split("<body>")[0]


def test_points_have_the_indices_asked_for_of_reflectance(solid, tmp_path):
    outputs = ["--outputs", "index:redness", "index:r650/r450"]
    ended = run(export, *words("point-cloud", "--run", solid.run, "--output", tmp_path, *outputs))
    assert ended.status == 0, ended.err
    ply = PlyData.read(tmp_path / "points.ply")
    redness, ratio = (np.asarray(ply["vertex"][name]) for name in ("index_redness", "index_1"))
    assert redness.dtype == ratio.dtype == np.float32
    assert np.isfinite(redness).all()
    assert (np.abs(redness) <= 1).all()
    assert redness.std() > 0
    assert [line.split(":")[0] for line in ply.comments[-2:]] == ["index_redness", "index_1"]
    assert "of radiance" not in ply.comments[-1]


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


def test_a_place_has_mean_and_spread_of_what_the_views_measured_that_see_it(solid, tmp_path, monkeypatch):
    words = [
        "spectrum",
        "--view",
        0,
        "--pixel",
        "8,8",
        "--run",
        solid.run,
        "--output",
        tmp_path,
        "--overwrite",
    ]
    assert (
        "fewer than two training views see the place" in run(export, *words).out
    )  # only the hull stands yet
    monkeypatch.setattr("unmix_plugin.products.spectrum._SAME_PLACE_PX", np.inf)
    monkeypatch.setattr("unmix_plugin.products.spectrum._WHOLE", 0.0)
    assert run(export, *words).status == 0
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
    for name, expected in (
        ("mean over views", np.mean(spectra, axis=0)),
        ("standard deviation over views", np.std(spectra, axis=0, ddof=1)),
    ):
        np.testing.assert_allclose([float(row[name]) for row in rows], expected, atol=1e-6)


def test_a_view_goes_by_its_number_too_and_a_point_by_its_coordinates(solid, tmp_path):
    common = ["--run", solid.run, "--output", tmp_path, "--device", "cpu"]
    assert run(export, "spectrum", "--view", 0, "--pixel", "8,8", *common).status == 0
    assert (tmp_path / "eval_002_x8_y8.csv").is_file()
    assert run(export, "spectrum", "--point", "-0.0,0.05,0.2", *common).status == 0
    with (tmp_path / "point_0_0.05_0.2.csv").open() as file:
        assert next(csv.reader(file)) == ["wavelength", "predicted"]


def test_own_reflectances_are_compared_with_too(solid, tmp_path):
    wavelengths = load_run(solid.run, "cpu").record.metadata["wavelengths_nm"]
    lines = [f"{wavelength},{0.1 + 0.05 * index}" for index, wavelength in enumerate(wavelengths)]
    (tmp_path / "mine.csv").write_text("\n".join(["wavelength,my very own", *lines]))
    common = ["--run", solid.run, "--output", tmp_path / "out", "--device", "cpu"]
    common += ["--library", tmp_path / "mine.csv", "+builtin"]
    compared = ["--view", 0, "--pixel", "8,8", "--compare", "continuum"]
    assert run(export, "spectrum", *compared, *common).status == 0
    assert run(export, "report", "--max-views", 1, *common).status == 0
    assert "175 known" in (tmp_path / "out" / "report.html").read_text()
    ended = run(export, "spectrum", "--view", 0, "--pixel", "9,9", *common[:-1], tmp_path / "none.csv")
    assert ended.status == 2
    assert "none.csv: can't read" in ended.err


def test_a_report_with_the_find_scene_compares_and_is_self_contained(exported):
    page = (exported[0] / "report" / "report.html").read_text()
    outline = assert_self_contained(page)
    assert outline.ids == [
        "scene", "views", "materials", "abundances", "segmentation", "figures", "error", "worst", "settings",
        "versions",
    ]  # fmt: skip
    assert "Rendered: 1 of 2 evaluation views." in outline.text
    assert "Of the 1 views rendered for this report." in outline.text
    assert "intersection over union" in outline.text
    assert re.search(r"6 materials told apart in 6 views: endmember_\d \(\d+% of what is seen", outline.text)
    assert re.search(r"estimated probability of \d+% on average", outline.text)
    assert "num_endmembers" in outline.text


def test_a_report_keeps_what_it_is_about_with_the_run(solid_copy):
    given = [
        "--title",
        "Panel <A>",
        "--author",
        "A. Nobody",
        "--object",
        "icon",
        "--notes",
        "found in 1931\nwaxed",
    ]
    assert run(export, *words("report", "--run", solid_copy, *given, "--number", "12.7")).status == 0
    ended = run(export, *words("report", "--run", solid_copy, "--overwrite", "--number", ""))
    assert ended.status == 0, ended.err
    page = (solid_copy / "exports" / "report" / "report.html").read_text()
    assert "<h1>Panel &lt;A&gt;</h1>" in page
    assert all(text in page for text in ("A. Nobody", "icon", "found in 1931\nwaxed"))
    assert "12.7" not in page
    kept = solid_copy / "report.json"
    kept.write_text(kept.read_text().replace('"icon"', "[1]"))
    ended = run(export, *words("report", "--run", solid_copy, "--overwrite"))
    assert (ended.status, "report.json is damaged" in ended.err) == (2, True)


def test_a_report_shows_the_regions_that_are_kept_and_says_which_it_cannot(solid_copy):
    names = load_run(solid_copy, "cpu").materials_scene.materials.names
    far = Box((90.0, 90.0, 90.0), (91.0, 91.0, 91.0))
    everything = Box((-90.0, -90.0, -90.0), (90.0, 90.0, 90.0))
    for name, region in (("all of it", everything), ("far away", far)):
        keep_region(RunFolder(solid_copy), name, region)
    assert run(export, *words("report", "--run", solid_copy)).status == 0
    page = (solid_copy / "exports" / "report" / "report.html").read_text()
    assert_self_contained(page)
    section = page.partition('<section id="regions">')[2].partition("</section>")[0]
    assert re.search(r"<h3>all of it <span class=.note.>[0-9.]+ square units", section)
    assert "mean spectrum of the region all of it" in section
    shares = [float(share) for share in re.findall(r'<td class="number">([0-9.]+)</td>', section)]
    assert (len(shares), sum(shares)) == (len(names), pytest.approx(1, abs=0.01))
    assert "Not shown: the region far away has nothing of the surface in it" in page
    assert "far away" not in section


def test_a_report_quotes_the_figures_that_eval_found(solid_copy, tmp_path, monkeypatch):
    (solid_copy / "eval").mkdir()
    (solid_copy / "eval" / "metrics.json").write_text(
        json.dumps({"psnr": 12.34, "miou": None, "definitions": {}})
    )
    assert run(export, *words("report", "--run", solid_copy)).status == 0
    page = (solid_copy / "exports" / "report" / "report.html").read_text()
    assert "in 3-D" not in page
    (solid_copy / "exports" / "page").mkdir()
    (solid_copy / "exports" / "page" / "page.html").touch()
    moved, out = solid_copy.rename(tmp_path / "50 % #1"), ["--output", tmp_path / "out", "--overwrite"]
    assert run(export, *words("report", "--run", moved, *out)).status == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert '<a href="../50%20%25%20%231/exports/page/page.html">in 3-D</a>' in page
    assert "eval/metrics.json" in page
    assert "12.34" in page
    # On Windows, there is no relative path to another drive.
    monkeypatch.setattr(
        "os.path.relpath", Mock(side_effect=ValueError("path is on mount 'C:', start on 'D:'"))
    )
    assert run(export, *words("report", "--run", moved, *out)).status == 0
    assert "in 3-D" not in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("mesh", "point-cloud")])
def test_every_product_can_be_edited_and_relit(solid, tmp_path, name):
    recipe = tmp_path / "recipe.yml"
    recipe.write_text("edits:\n  - rename: {endmember: 0, name: old oak}\n")
    common = ["--run", solid.run, "--output", tmp_path / "out", "--edits", recipe, "--illuminant", "A"]
    ended = run(export, *words(name, *common))
    assert ended.status == 0, ended.err
    if name == "endmembers":
        plain, lit = (open_run(solid.run, "cpu").materials, tmp_path / "out" / "endmembers.csv")
        with lit.open() as file:
            rows = list(csv.DictReader(file))
        assert "old oak" in rows[0]
        reddened = np.array([float(row["old oak"]) for row in rows]) / plain.endmembers[0].detach().numpy()
        assert reddened[-1] > 3 * reddened[0]
    if name == "report":
        page = (tmp_path / "out" / "report.html").read_text()
        assert "old oak" in page
        assert "Edited: what is rendered here" in page
        assert "Worst views" not in page


def test_a_known_distance_is_kept_and_exports_say_it(solid_copy, tmp_path):
    two = ["scale", "--run", solid_copy, "--points", "eval_002:7,8", "eval_002:9,8", "--distance"]
    ended = run(export, *two, 0)
    assert (ended.status, "must be greater than 0" in ended.err) == (2, True)
    assert run(export, *two, 0.12).status == 0
    scene = open_run(solid_copy, "cpu")
    view = next(view for view in scene.views if view.name == "eval_002")
    ends = [scene.probe(view.camera, column, 8).world_position for column in (7, 9)]
    assert scene.scale is not None
    assert ends[0] is not None
    assert ends[1] is not None
    assert scene.scale.metres_per_unit * np.linalg.norm(ends[1] - ends[0]) == pytest.approx(0.12)
    assert run(export, *words("poses", "--run", solid_copy, "--output", tmp_path)).status == 0
    written = json.loads((tmp_path / "transforms.json").read_text())
    assert written["metres_per_unit"] == scene.scale.metres_per_unit
    assert scene.scale.said in run(export, "scale", "--run", solid_copy).out
    for words_given, message in (
        (["--points", "0 0 90", "eval_002:9,8", "--distance", 1], "is not on the object"),
        (["--points", "0 0", "0 0 1", "--distance", 1], "is no point: expected x y z"),
        (["--distance", 1], "give both"),
    ):
        ended = run(export, "scale", "--run", solid_copy, *words_given)
        assert (ended.status, message in ended.err) == (2, True), ended.err


def test_removed_matter_leaves_the_surface(solid, tmp_path):
    recipe = tmp_path / "recipe.yml"
    assert run(export, *words("point-cloud", "--run", solid.run, "--output", tmp_path / "all")).status == 0
    vertices = PlyData.read(tmp_path / "all" / "points.ply")["vertex"]
    material = int(np.bincount(vertices["material"]).argmax())
    recipe.write_text(f"edits:\n  - remove: {material}\n")
    ended = run(
        export, *words("point-cloud", "--run", solid.run, "--output", tmp_path / "some", "--edits", recipe)
    )
    assert ended.status == 0, ended.err
    left = PlyData.read(tmp_path / "some" / "points.ply")["vertex"]
    assert (left["material"] == material).mean() < 0.5 * (vertices["material"] == material).mean()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["spectrum"], "give a pixel with --view and --pixel, a point with --point, or a region"),
        (["spectrum", "--view", "1", "--point", "1,2,3"], "give a pixel with --view and --pixel"),
        (["spectrum", "--view", "eval_003", "--pixel", "1,1"], "no view 'eval_003' (did you mean"),
        (["spectrum", "--view", "2", "--pixel", "1,1"], "a number from 0 to 1"),
        (["spectrum", "--view", "1", "--pixel", "16,1"], "columns are 0 to 15, rows 0 to 15"),
        (["spectrum", "--view", "1", "--pixel", "1"], "--pixel 1 is not a column and a row"),
        (["spectrum", "--point", "1,2"], "--point 1,2 is not 3 numbers"),
        (["spectrum", "--point", "1,2,nan"], "--point 1,2,nan is not 3 numbers"),
        (["spectrum", "--point", "99,0,0"], "outside the scene box"),
        (["point-cloud", "--num-points", "0"], "--num-points is 0"),
        (["point-cloud", "--outputs", "rgb"], "--outputs rgb: points take spectral indices, index:NAME"),
        (["point-cloud", "--outputs", "index:nvdi"], "there is no index 'nvdi'; nearest:"),
        (["point-cloud", "--outputs", "target:none.csv"], "none.csv"),
        (["mesh", "--resolution", "2000"], "--resolution is 2000"),
        (["mesh", "--density", "-1"], "--density is -1"),
        (["mesh", "--smoothing", "99"], "--smoothing is 99"),
        (["volume", "--resolution", "1"], "--resolution is 1"),
        (["report", "--max-views", "0"], "--max-views is 0"),
        (["cubes", "--illuminant", "D66"], "D65"),
        (["cubes", "--edits", "none.yml"], "none.yml"),
    ],
)
def test_bad_options_are_refused_with_what_to_do(solid, tmp_path, given, said):
    ended = run(export, *given, "--run", solid.run, "--output", tmp_path / "out", "--device", "cpu")
    assert ended.status == 2
    assert said in ended.err
    assert not (tmp_path / "out").exists()
