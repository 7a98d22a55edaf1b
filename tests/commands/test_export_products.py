"""`unmix-export` of every product: from a run alone, with its scene, edited, relit, never over other files."""

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import spectral.io.envi as envi
from plyfile import PlyData

from tests.commands.running import picture_size, run
from tests.products.mesh_reading import loaded_mesh
from tests.products.report.page_outline import assert_self_contained
from unmix_plugin.commands.export import PRODUCTS, export
from unmix_plugin.scenes import load_scene
from unmix_plugin.settings import SceneOptions
from unmix_plugin.trained.open_run import load_run, open_run

SMALL = {
    "cubes": ["--formats", "envi", "exr", "npy"],
    "mesh": ["--formats", "ply", "obj", "glb", "--resolution", 24],
    "point-cloud": ["--num-points", 500],
    "report": ["--max-views", 1],
    "spectrum": ["--view", "eval_002", "--pixel", "8,8"],
    "volume": ["--resolution", 8],
}
NAMES = [product.name for product in PRODUCTS]


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
    common += ["--library", tmp_path / "mine.csv"]
    compared = ["--view", 0, "--pixel", "8,8", "--compare", "continuum"]
    assert run(export, "spectrum", *compared, *common).status == 0
    assert run(export, "report", "--max-views", 1, *common).status == 0
    assert "184 known" in (tmp_path / "out" / "report.html").read_text()
    ended = run(export, "spectrum", "--view", 0, "--pixel", "9,9", *common[:-1], tmp_path / "none.csv")
    assert ended.status == 2
    assert "none.csv: can't read" in ended.err


def test_a_report_with_the_find_scene_compares_and_is_self_contained(exported):
    page = (exported[0] / "report" / "report.html").read_text()
    outline = assert_self_contained(page)
    assert outline.ids == [
        "scene", "views", "materials", "abundances", "segmentation", "figures", "error", "worst", "training",
        "settings", "versions",
    ]  # fmt: skip
    assert "Rendered: 1 of 2 evaluation views." in outline.text
    assert "Of the 1 views rendered for this report." in outline.text
    assert "intersection over union" in outline.text
    assert 'alt="loss over training"' in page
    assert "num_endmembers" in outline.text


def test_a_report_quotes_the_figures_that_eval_found(solid_copy):
    (solid_copy / "eval").mkdir()
    (solid_copy / "eval" / "metrics.json").write_text(
        json.dumps({"psnr": 12.34, "miou": None, "definitions": {}})
    )
    assert run(export, *words("report", "--run", solid_copy)).status == 0
    page = (solid_copy / "exports" / "report" / "report.html").read_text()
    assert "eval/metrics.json" in page
    assert "12.34" in page


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
        (["spectrum"], "give a pixel with --view and --pixel, or a point with --point"),
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
