"""`unmix-export`: what is written, what is in it and what is refused, of a run alone or edited; products of methods."""

import base64
import csv
import gzip
import json
import re
import shutil
from importlib.metadata import EntryPoint
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from plyfile import PlyData

from tests.engine.conftest import registered, short_config  # noqa: F401 (fixtures)
from tests.factories.commands import done, picture_size, refused, run
from tests.factories.outputs import loaded_mesh
from tests.factories.pages import assert_self_contained
from tests.factories.runs import PRODUCT_NAMES, lose_scene
from tests.factories.runs import export_words as words
from tests.factories.trainings import finished
from unmix_plugin.commands.export import export
from unmix_plugin.engine import registry
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.formats.envi import read_header
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.library.spectra_csv import read_spectra
from unmix_plugin.trained.measured_errors import write_errors
from unmix_plugin.trained.measures import keep_region
from unmix_plugin.trained.open_run import load_run, open_run
from unmix_plugin.trained.place_errors import ComparedPixels, PlaceErrors
from unmix_plugin.trained.regions import Box
from unmix_plugin.trained.surface_mesh import TriangleMesh, vertex_areas

pytestmark = pytest.mark.usefixtures("coarse_surfaces")


def test_views_are_chosen_by_split_and_named_as_the_frames(trained, tmp_path):
    frames = {path.stem for path in (trained.scene / "cubes").glob("[!.]*")}
    for views, count in (("train", 6), ("all", 8)):
        folder = tmp_path / views
        words = ["--run", trained.run, "--output", folder, "--views", views, "--formats", "npy"]
        done(export, "abundances", *words)
        names = {path.stem for path in folder.glob("*.npy")}
        assert len(names) == count
        assert names == {name for name in frames if views == "all" or name.startswith(views)}


def entry(name, value):
    return EntryPoint(name, f"tests.factories.own_product:{value}", registry.METHOD_GROUP)


@pytest.fixture
def own(registered):  # noqa: F811
    registered[:] = [entry("rgb-nerf", "with_product")]
    return registered


@pytest.mark.usefixtures("own")
def test_a_product_of_a_method_is_listed_and_written_with_its_options(short_config, tmp_path):  # noqa: F811
    trainer = finished(short_config)
    assert "view-names" in run(export, "--help").out
    words = ["view-names", "--run", trainer.run.path, "--output", tmp_path / "out", "--device", "cpu"]
    done(export, *words, "--capitals")
    names = (tmp_path / "out" / "names.txt").read_text().split()
    assert len(names) == 12
    assert names[0] == "EVAL_000"
    assert "--overwrite" in run(export, *words).err
    refused(export, *words, "--edits", "recipe.yml")


def test_a_product_is_refused_for_runs_of_other_methods(own, trained, tmp_path):
    own.append(EntryPoint("unmix-nerf", "unmix_plugin.method_config:unmix_nerf", registry.METHOD_GROUP))
    said = refused(export, "view-names", "--run", trained.run, "--output", tmp_path, "--device", "cpu")
    assert "the method unmix-nerf has no product view-names: it needs a run of rgb-nerf" in said


def test_products_that_fail_or_whose_name_is_taken_are_skipped_and_said(own):
    own += [entry("rgb-2", "clashing"), entry("rgb-3", "broken")]
    ended = done(export, "--help")
    assert "skipped the plugin rgb-2: another product has the name mesh already" in ended.err
    assert "skipped the plugin rgb-3: its products: ImportError: no module named scissors" in ended.err
    assert "view-names" in ended.out
    assert run(export, "mesh", "--help").out.count("--smoothing") > 0


@pytest.mark.parametrize("name", PRODUCT_NAMES)
def test_every_file_written_is_named_and_nothing_else_is_there(exported, name):
    root, said = exported
    files = sorted(str(path) for path in (root / name).rglob("[!.]*") if path.is_file())
    assert files
    lines = said[name].splitlines()
    assert sorted(line for line in lines if line.startswith(str(root))) == files
    assert lines[-1] == f"{len(files)} file{'s' if len(files) > 1 else ''} written to {root / name}"


@pytest.fixture(scope="module")
def alone(solid, tmp_path_factory):
    """A copy of the run whose scene is gone."""
    copy = shutil.copytree(solid.run, tmp_path_factory.mktemp("alone") / solid.run.name)
    lose_scene(copy, solid.scene)
    return copy


@pytest.mark.parametrize("name", PRODUCT_NAMES)
def test_a_file_is_replaced_only_by_overwrite_also_edited_relit_and_of_the_run_folder_alone(
    alone, exported, tmp_path, name
):
    copy = shutil.copytree(exported[0] / name, tmp_path / name)
    *others, victim = sorted(path for path in copy.rglob("[!.]*") if path.is_file())
    for path in others:
        path.unlink()
    ours = victim.read_bytes()
    victim.write_bytes(b"mine")
    given = words(name, "--run", alone, "--output", copy)
    said = refused(export, *given)
    assert str(victim) in said
    assert "--overwrite" in said
    assert [path.read_bytes() for path in copy.rglob("[!.]*") if path.is_file()] == [b"mine"]
    recipe = tmp_path / "recipe.yml"
    recipe.write_text("edits:\n  - rename: {endmember: 0, name: old oak}\n")
    edited = (*given, "--overwrite", "--edits", recipe, "--illuminant", "A")
    assert f"{victim} is in the way" in refused(export, *edited)
    assert victim.read_bytes() == b"mine"
    victim.write_bytes(ours)
    victim.touch()
    before = victim.stat().st_ino
    done(export, *edited)
    assert victim.stat().st_ino != before
    if name == "endmembers":
        with (copy / "endmembers.csv").open() as file:
            lit = [float(row["old oak"]) for row in csv.DictReader(file)]
        reddened = lit / open_run(alone, "cpu").materials.endmembers[0].detach().numpy()
        assert reddened[-1] > 3 * reddened[0]
    if name == "report":
        page = (copy / "report.html").read_text()
        assert "old oak" in page
        assert "Edited: what is rendered here" in page
        assert "Worst views" not in page
        assert "Not evaluated: run unmix-eval" in page
        assert_self_contained(page)
    if name == "spectrum":
        with (copy / "eval_002_x8_y8.csv").open() as file:
            heads = next(csv.reader(file))
        shown = [head for head in heads if not head.endswith(("_low", "_high"))]
        assert shown == ["wavelength", "predicted", "diffuse", "specular"]


def test_more_views_are_segmented_into_a_folder_with_the_same_legend(solid, tmp_path):
    common = ["--run", solid.run, "--output", tmp_path, "--device", "cpu"]
    done(export, "segmentation", *common)
    done(export, "segmentation", "--views", "train", *common)
    assert len(list((tmp_path / "labels").glob("[!.]*"))) == 8
    (tmp_path / "legend.csv").write_text("mine")
    shutil.rmtree(tmp_path / "labels")
    for path in (*tmp_path.glob("*.npy"), *tmp_path.glob("*.png")):
        path.unlink()
    assert "legend.csv exist" in refused(export, "segmentation", *common)


def test_a_known_distance_is_kept_and_exports_say_it(solid_copy, tmp_path):
    known = ["scale", "--run", solid_copy]
    done(export, *known, "--points", "eval_002:7,8", "eval_002:9,8", "--distance", 0.12)
    scene = open_run(solid_copy, "cpu")
    view = next(view for view in scene.views if view.name == "eval_002")
    ends = [scene.probe(view.camera, column, 8).world_position for column in (7, 9)]
    assert scene.scale is not None
    length = np.linalg.norm(np.subtract(ends[1], ends[0]))  # type: ignore[arg-type]
    assert scene.scale.metres_per_unit * length == pytest.approx(0.12)
    done(export, *words("poses", "--run", solid_copy, "--output", tmp_path))
    written = json.loads((tmp_path / "transforms.json").read_text())
    assert written["metres_per_unit"] == scene.scale.metres_per_unit
    assert scene.scale.in_words in run(export, *known).out
    for given, message in (
        (["--points", "eval_002:7,8", "eval_002:9,8", "--distance", 0], "must be greater than 0"),
        (["--points", "0 0 90", "eval_002:9,8", "--distance", 1], "is not on the object"),
        (["--points", "0 0", "0 0 1", "--distance", 1], "is no point: expected x y z"),
        (["--distance", 1], "give both"),
    ):
        assert message in refused(export, *known, *given)


def test_removed_matter_leaves_the_surface(solid, tmp_path):
    recipe, common = tmp_path / "recipe.yml", ["point-cloud", "--run", solid.run]
    done(export, *words(*common, "--output", tmp_path / "all"))
    before = np.asarray(PlyData.read(tmp_path / "all" / "points.ply")["vertex"]["scalar_material"])
    material = int(np.bincount(before).argmax())
    recipe.write_text(f"edits:\n  - remove: {material}\n")
    done(export, *words(*common, "--output", tmp_path / "some", "--edits", recipe))
    left = PlyData.read(tmp_path / "some" / "points.ply")["vertex"]["scalar_material"]
    assert (left == material).mean() < 0.5 * (before == material).mean()


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
        (["spectrum", "--point", "99,0,0"], "outside the scene box"),
        (["report", "--max-views", "0"], "--max-views is 0"),
    ],
)
def test_bad_options_are_refused_with_what_to_do(solid, tmp_path, given, said):
    words = ["--run", solid.run, "--output", tmp_path / "out", "--device", "cpu"]
    assert said in refused(export, *given, *words)
    assert not (tmp_path / "out").exists()


def test_endmembers_are_those_of_the_run(solid, exported):
    names = solid.run / "endmembers.csv", exported[0] / "endmembers" / "endmembers.csv"
    assert names[0].read_bytes() == names[1].read_bytes()


def test_points_and_mesh_lie_where_the_scene_is(solid, exported):
    scene = load_scene(solid.scene, SceneOptions())
    corners = scene.normalisation.to_world(scene.scene_box.aabb.numpy())
    low, high = corners.min(axis=0) - 0.2, corners.max(axis=0) + 0.2
    points = PlyData.read(exported[0] / "point-cloud" / "points.ply")["vertex"]
    vertices = [np.stack([points[axis] for axis in "xyz"], axis=1)]
    ply, *others = (loaded_mesh(exported[0] / "mesh" / f"mesh.{kind}") for kind in ("ply", "obj", "glb"))
    vertices += [
        ply.vertices,
        *(mesh.vertices[:, [0, 2, 1]] * [1, -1, 1] for mesh in others),
    ]  # whose y is up
    assert 100 < len(vertices[0]) <= 500
    assert all(((low <= one) & (one <= high)).all() for one in vertices)
    for name in ("mesh", "splats"):
        said = " ".join(exported[1][name].split())
        assert f"lengths in {name}.glb are in units of the scene, of unknown size" in said


def test_both_files_of_splats_hold_the_same_gaussians(exported):
    ply = PlyData.read(exported[0] / "splats" / "splats.ply")["vertex"]
    path = exported[0] / "splats" / "splats.glb"
    content = json_of(path)
    [primitive] = content["meshes"][0]["primitives"]
    assert (primitive["mode"], content["extensionsUsed"]) == (0, ["KHR_gaussian_splatting"])
    binary = path.read_bytes()[28 + int.from_bytes(path.read_bytes()[12:16], "little") :]

    def column(name):
        accessor = content["accessors"][primitive["attributes"][name]]
        start = content["bufferViews"][accessor["bufferView"]]["byteOffset"]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(binary, "<f4", accessor["count"] * width, start).reshape(-1, width)

    own = "KHR_gaussian_splatting"
    opacities = column(f"{own}:OPACITY")[:, 0]
    np.testing.assert_allclose(np.log(opacities / (1 - opacities)), ply["opacity"], rtol=1e-3, atol=1e-3)
    sizes = np.exp(np.stack([ply[f"scale_{axis}"] for axis in range(3)], axis=1))
    np.testing.assert_allclose(column(f"{own}:SCALE"), sizes, rtol=1e-4)
    harmonics = np.stack([ply[f"f_dc_{axis}"] for axis in range(3)], axis=1)
    np.testing.assert_array_equal(column(f"{own}:SH_DEGREE_0_COEF_0"), harmonics)
    shares = np.stack(
        [ply[each.name] for each in ply.properties if each.name.startswith("abundance_")], axis=1
    )
    np.testing.assert_allclose(shares.sum(axis=1), 1, atol=1e-4)


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
    parts = {name: (how["type"], how["count"], how["start"]) for name, how in layout.items()}
    stored = {name: np.frombuffer(data, *part) for name, part in parts.items()}
    mesh, place = loaded_mesh(exported[0] / "mesh" / "mesh.ply"), layout["positions"]
    found = stored["positions"].reshape(-1, 3) * place["scale"] + place["offset"]
    np.testing.assert_allclose(found, mesh.vertices, atol=0.6 * place["scale"])
    np.testing.assert_array_equal(np.cumsum(stored["faces"]).reshape(-1, 3), mesh.faces)
    sheet = TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    expected = vertex_areas(sheet.areas(), sheet.faces, len(sheet.vertices))
    np.testing.assert_allclose(stored["areas"], expected, rtol=1e-5)
    shares = layout["abundances"]["scale"] * (stored["abundances"].reshape(-1, 6) / 1.0) ** 2
    seen = shares.sum(axis=1)
    seen = seen[seen > 0]  # there is nothing under a few places of so coarse a surface
    assert len(seen) > 0.98 * len(shares)
    np.testing.assert_allclose(seen, 1, atol=0.03)
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


@pytest.mark.parametrize(
    ("recipe", "words"),
    [("edits: [{scale: {endmember: 0, factor: 0.5}}]", " before the edits"), ("illuminant: A", "")],
)
def test_what_was_measured_is_told_from_edited_materials(solid, tmp_path, recipe, words):
    (tmp_path / "edits.yml").write_text(recipe)
    common = ["spectrum", "--view", "eval_002", "--pixel", "8,8", "--run", solid.run, "--output", tmp_path]
    done(export, *common, "--edits", tmp_path / "edits.yml")
    heads = (tmp_path / "eval_002_x8_y8.csv").read_text().splitlines()[0].split(",")
    assert heads == [
        "wavelength",
        "predicted",
        "diffuse",
        "specular",
        f"measured{words}",
        f"mean over views{words}",
    ]


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
    assert "measured" in heads["8,8"]
    assert "measured" not in heads["8,9"]


def test_a_place_has_mean_and_spread_of_what_the_views_measured_that_see_it(solid, tmp_path, monkeypatch):
    place = ["spectrum", "--view", 0, "--pixel", "8,8"]
    words = [*place, "--run", solid.run, "--output", tmp_path, "--overwrite"]
    assert "fewer than two training views see the place" in run(export, *words).out  # only the hull stands
    monkeypatch.setattr("unmix_plugin.trained.places._SAME_PLACE_PX", np.inf)
    monkeypatch.setattr("unmix_plugin.trained.places._WHOLE_ALPHA", 0.0)
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
        assert next(csv.reader(file))[:2] == ["wavelength", "predicted"]


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
        r"6 materials told apart in 6 views: [a-z ]+ \d \(\d+% of what is seen",
        r"estimated probability of \d+% on average",
        "num_endmembers",
    ):
        assert re.search(text, outline.text), text


def test_numbers_stand_between_the_ends_of_their_intervals(solid_copy):
    loaded = load_run(solid_copy, "cpu")
    scene, generator = loaded.materials_scene, torch.Generator().manual_seed(0)
    low, high = scene.scene_box.aabb
    places = low + torch.rand(20_000, 3, generator=generator) * (high - low)
    size = (len(places), len(scene.materials.names))
    abundances, spectra = torch.full(size, 1 / size[1]), torch.ones(len(places), len(scene.bands))
    possible = abundances + 0.05 * torch.randn(size, generator=generator) + 0.02
    measured = spectra + 0.01 * torch.randn(spectra.shape, generator=generator) + 0.01
    views = torch.randint(0, 5, (len(places),), generator=generator)
    compared = ComparedPixels(places, views, spectra, measured, abundances, possible[None])
    errors = PlaceErrors.fit(
        compared,
        scene.materials.endmembers.cpu(),
        0.01 * scene.materials.endmembers.cpu(),
        low,
        0.25 * float((high - low).max()),
    )
    write_errors(solid_copy, errors, loaded.training.steps)

    done(export, *words("endmembers", "--run", solid_copy))
    ends = read_spectra(solid_copy / "exports/endmembers/endmembers-intervals.csv")
    assert ends.names[:2] == tuple(f"{scene.materials.names[0]}{end}" for end in ("_low", "_high"))
    assert (ends.spectra[0] < scene.materials.endmembers[0].numpy()).all()
    assert (ends.spectra[1] > scene.materials.endmembers[0].numpy()).all()
    done(export, *words("regions", "--run", solid_copy))
    with (solid_copy / "exports/regions/regions.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name in ("area_square_units", *scene.materials.names):
        for row in rows:
            low, value, high = (float(row[f"{name}{end}"]) for end in ("_low", "", "_high"))
            assert low <= value <= high
            assert low < high or name == "area_square_units"  # of a solid one
    assert {row["area_cm2_low"] for row in rows} == {""}

    keep_region(RunFolder(solid_copy), "all", Box((-90.0, -90.0, -90.0), (90.0, 90.0, 90.0)))
    done(export, "spectrum", "--region", "all", "--run", solid_copy, "--device", "cpu")
    folder = solid_copy / "exports/spectrum"
    with (folder / "region_all.csv").open() as file:
        assert all(
            float(row["mean_low"]) <= float(row["mean"]) <= float(row["mean_high"])
            for row in csv.DictReader(file)
        )
    facts = json.loads((folder / "region_all.json").read_text())
    assert facts["interval"] == {"coverage": 0.9, "not_determined": None}
    for name, value in facts["abundances"].items():
        assert facts["abundances_low"][name] <= value <= facts["abundances_high"][name]

    write_errors(solid_copy, None, loaded.training.steps)
    said = done(export, *words("regions", "--run", solid_copy, "--overwrite")).out
    assert "not determined: the run has no errors.safetensors" in " ".join(said.split())


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
    said = {
        "regions/regions.hdr": "mean spectra of regions",
        "spectrum/region_all of it.hdr": "mean spectrum",
    }
    for file, about in said.items():
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
