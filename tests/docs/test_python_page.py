"""docs/guides/python.md: its names are the public ones, and its code and the notebook's run as they stand."""

import inspect
import re
import shutil

import numpy as np
import pytest

import unmix_plugin
from tests.factories.commands import picture_size
from tests.factories.models import CAMERA, make_scene
from tests.factories.pages import blocks_of, text_of
from unmix_plugin import read_recipe
from unmix_plugin.editing import edit_scene, recipe_from_yaml


def test_the_public_names_are_those_that_the_page_lists():
    table = text_of("docs/guides/python.md").split("\n## ")[0]
    assert sorted(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == sorted(unmix_plugin.__all__)
    assert len(unmix_plugin.__all__) <= 14
    with pytest.raises(AttributeError, match="has no attribute 'Trainer'"):
        _ = unmix_plugin.Trainer


@pytest.mark.parametrize("name", unmix_plugin.__all__)
def test_a_public_name_says_what_it_is(name):
    thing = getattr(unmix_plugin, name)
    assert thing.__name__ == name
    assert not thing.__doc__.startswith(f"{name}(")  # what a dataclass writes if nobody else does
    assert name in dir(unmix_plugin)
    if inspect.isclass(thing):
        methods = [one for key, one in vars(thing).items() if callable(one) and not key.startswith("_")]
        assert all(method.__doc__ for method in methods)


def test_the_examples_run_one_after_the_other(home, trained):
    shutil.copytree(trained.scene, home / "my-scene")
    names = {}
    for code in blocks_of("docs/guides/python.md", "python"):
        short = code.replace("(4, 6)", "(6,)").replace("max_seconds=120", "max_num_iterations=2")
        exec(compile(short, "docs/guides/python.md", "exec"), names)
    height, width = names["rgb"].shape[:2]
    assert names["cube"].shape == (height, width, len(names["wavelengths"]))
    assert names["edited"].materials.names[2] == "wood"
    assert not np.allclose(names["picture"], names["rgb"], atol=0.05)
    np.testing.assert_allclose(np.load(home / "abundances.npy"), names["abundances"], atol=1e-6)
    assert picture_size(home / "view.png") == (width, height)
    assert len(list(home.glob("sweep/*/my-scene/unmix-nerf/*/endmembers.csv"))) == 1
    assert picture_size(home / "sweep" / "6.png") == (width, height)
    assert {path.name for path in home.glob("view.*")} == {"view.png", "view.hdr", "view.img"}


def test_the_example_of_editing_runs(home):
    (code,) = blocks_of("docs/guides/editing.md", "python")
    names = {}
    exec(compile(code, "docs/guides/editing.md", "exec"), names)
    assert read_recipe(home / "edits.yml") == names["recipe"]
    assert names["views"]["rgb"].shape == (16, 16, 3)


@pytest.mark.usefixtures("home")
def test_the_page_lists_every_output_and_each_has_the_shape_that_it_says():
    names = {}
    exec(blocks_of("docs/guides/python.md", "python")[0], names)
    scene = names["scene"]
    section = text_of("docs/guides/python.md").split("| output | shape | |\n")[1].split("\n\n")[0]
    rows = [row.split("|")[1:3] for row in section.splitlines()[1:]]
    shapes = {name: shape.strip() for named, shape in rows for name in re.findall(r"`([^`]+)`", named)}
    offered = {output.name for output in scene.outputs} | {"unexplained"}  # of longer trainings
    assert {name for name in shapes if ":" not in name} == offered
    camera = scene.views[-1].camera
    length = {"H": camera.height, "W": camera.width, "3": 3}
    length |= {"B": len(scene.bands), "K": len(scene.materials.names)}
    view = scene.look(camera)
    elsewhere = {
        "unexplained",
        "target:paint.csv",
        "library:mine.csv",
        "index:ndvi",
        "false-colour:860,650,550",
    }
    for name in set(shapes) - elsewhere:
        assert view[name].shape == tuple(length[axis] for axis in re.findall(r"\w", shapes[name])), name


RECIPES = [
    pytest.param(block, id=f"{page}-{number}")
    for page in ("README.md", "docs/guides/editing.md")
    for number, block in enumerate(blocks_of(page, "yaml"))
    if "edits:" in block or "illuminant:" in block
]


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_documented_recipe_works(tmp_path, recipe):
    (tmp_path / "paints.csv").write_text("wavelength,ochre,umber\n300,0.2,0.1\n1100,0.6,0.3\n")
    scene = make_scene(num_endmembers=5)
    edited = edit_scene(scene, recipe_from_yaml(recipe, "edits.yml", tmp_path))
    assert edited.render(CAMERA, ["rgb"])["rgb"].isfinite().all()
