"""`unmix-export`: what is written and refused, from a run alone, edited and relit; and products of methods."""

import csv
import json
import shutil
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from plyfile import PlyData

from tests.commands.conftest import PRODUCT_NAMES
from tests.commands.conftest import export_words as words
from tests.commands.running import done, refused, run
from tests.engine.conftest import registered, short_config  # noqa: F401 (fixtures)
from tests.engine.stopped_runs import finished
from tests.products.report.page_outline import assert_self_contained
from unmix_plugin.commands.export import export
from unmix_plugin.engine import registry
from unmix_plugin.trained.open_run import open_run


@pytest.mark.parametrize(("views", "count"), [("train", 6), ("all", 8)])
def test_views_are_chosen_by_split_and_named_as_the_frames(trained, tmp_path, views, count):
    done(export, "abundances", "--run", trained.run, "--output", tmp_path, "--views", views)
    names = {path.stem for path in tmp_path.glob("*.npy")}
    frames = {path.stem for path in (trained.scene / "cubes").iterdir()}
    assert len(names) == count
    assert names == {name for name in frames if views == "all" or name.startswith(views)}


def entry(name, value):
    return EntryPoint(name, f"tests.commands.own_product_plugin:{value}", registry.METHOD_GROUP)


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
    files = sorted(str(path) for path in (root / name).rglob("*") if path.is_file())
    assert files
    lines = said[name].splitlines()
    assert sorted(line for line in lines if line.startswith(str(root))) == files
    assert lines[-1] == f"{len(files)} file{'s' if len(files) > 1 else ''} written to {root / name}"


@pytest.mark.parametrize("name", PRODUCT_NAMES)
def test_no_file_is_replaced_unless_overwrite_is_given(solid, exported, tmp_path, name):
    copy = shutil.copytree(exported[0] / name, tmp_path / name)
    victim = sorted(path for path in copy.rglob("*") if path.is_file())[-1]
    for path in copy.rglob("*"):
        if path.is_file() and path != victim:
            path.unlink()
    victim.write_bytes(b"mine")
    said = refused(export, *words(name, "--run", solid.run, "--output", copy))
    assert str(victim) in said
    assert "--overwrite" in said
    assert [path.read_bytes() for path in copy.rglob("*") if path.is_file()] == [b"mine"]
    done(export, *words(name, "--run", solid.run, "--output", copy, "--overwrite"))
    assert victim.read_bytes() != b"mine"


def test_every_product_comes_from_the_run_folder_alone(solid, solid_copy, tmp_path):
    shutil.move(solid.scene, tmp_path / "elsewhere")
    try:
        for name in PRODUCT_NAMES:
            done(export, *words(name, "--run", solid_copy))
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
    done(export, "segmentation", *common)
    done(export, "segmentation", "--views", "train", *common)
    assert len(list((tmp_path / "labels").iterdir())) == 8
    (tmp_path / "legend.csv").write_text("mine")
    shutil.rmtree(tmp_path / "labels")
    for path in (*tmp_path.glob("*.npy"), *tmp_path.glob("*.png")):
        path.unlink()
    assert "legend.csv exist" in refused(export, "segmentation", *common)


@pytest.mark.parametrize("name", [name for name in PRODUCT_NAMES if name not in ("mesh", "point-cloud")])
def test_every_product_can_be_edited_and_relit(solid, tmp_path, name):
    recipe = tmp_path / "recipe.yml"
    recipe.write_text("edits:\n  - rename: {endmember: 0, name: old oak}\n")
    common = ["--run", solid.run, "--output", tmp_path / "out", "--edits", recipe, "--illuminant", "A"]
    done(export, *words(name, *common))
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
    assert scene.scale.said in run(export, *known).out
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
    before = np.asarray(PlyData.read(tmp_path / "all" / "points.ply")["vertex"]["material"])
    material = int(np.bincount(before).argmax())
    recipe.write_text(f"edits:\n  - remove: {material}\n")
    done(export, *words(*common, "--output", tmp_path / "some", "--edits", recipe))
    left = PlyData.read(tmp_path / "some" / "points.ply")["vertex"]["material"]
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
        (["point-cloud", "--outputs", "rgb"], "--outputs rgb: points take spectral indices, index:NAME"),
        (["mesh", "--resolution", "2000"], "--resolution is 2000"),
        (["report", "--max-views", "0"], "--max-views is 0"),
        (["cubes", "--edits", "none.yml"], "none.yml"),
    ],
)
def test_bad_options_are_refused_with_what_to_do(solid, tmp_path, given, said):
    assert said in refused(
        export, *given, "--run", solid.run, "--output", tmp_path / "out", "--device", "cpu"
    )
    assert not (tmp_path / "out").exists()
