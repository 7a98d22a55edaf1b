"""The recipes in the README and docs, run as they stand."""

import re
from pathlib import Path

import pytest

from tests.commands.running import SMALL_METHOD, run
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.scenes.demo.scene import make_demo_scene

ROOT = Path(__file__).parents[2]


def recipes_of(page: str) -> list[str]:
    """YAML blocks of a page that are recipes."""
    blocks = re.findall(r"^```yaml\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.M | re.S)
    return [block for block in blocks if "edits:" in block or "illuminant:" in block]


RECIPES = [
    pytest.param(recipe, id=f"{page}-{position}")
    for page in ("README.md", "docs/guides/editing.md")
    for position, recipe in enumerate(recipes_of(page))
]


@pytest.fixture(scope="module")
def five_materials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the README's number of endmembers."""
    folder = tmp_path_factory.mktemp("five")
    make_demo_scene(folder / "scene", 16, 8, 6)
    words = ["--data", folder / "scene", "--output-dir", folder / "outputs", "--max-num-iterations", 10]
    ended = run(train, "unmix-nerf", *words, "--pipeline.model.num-endmembers", 5, *SMALL_METHOD)
    assert ended.status == 0, ended.err
    return Path(ended.last_line.removeprefix("run: "))


def test_both_pages_have_recipes():
    assert len(recipes_of("README.md")) == 1
    assert len(recipes_of("docs/guides/editing.md")) >= 2


@pytest.mark.parametrize("recipe", RECIPES)
def test_a_documented_recipe_works(five_materials, tmp_path, recipe):
    (tmp_path / "paints.csv").write_text("wavelength,ochre,umber\n300,0.2,0.1\n1100,0.6,0.3\n")
    (tmp_path / "edits.yml").write_text(recipe)
    words = ["--edits", tmp_path / "edits.yml", "--outputs", "rgb", "--output", tmp_path / "out"]
    ended = run(render, "--run", five_materials, *words, "--device", "cpu")
    assert ended.status == 0, ended.err
    assert list((tmp_path / "out").rglob("*.png"))
