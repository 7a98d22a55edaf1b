"""Recipes as text: what is read, what is refused and where, and that writing is the inverse of reading."""

import re
import time
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from unmix_plugin.editing import (
    Gloss,
    Isolate,
    Light,
    Recipe,
    Remove,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
    read_recipe,
    recipe_from_yaml,
    recipe_to_yaml,
)
from unmix_plugin.errors import ConfigError

EVERY_EDIT = """\
# what a user might write
illuminant: d65
edits:
  - swap: [red, 3]
  - replace: {endmember: 2, library: ColorChecker/red}
  - replace:
      endmember: clay
      file: paints.csv
      spectrum: ochre
      extrapolate: true
  - retint: {endmember: 4, colour: '#3366CC'}
  - retint: {endmember: 5, colour: [0.1, 0.25, 1], match: spectrum}
  - scale: {endmember: 0, factor: 1.5}
  - remove: 6
  - isolate: [7, soil]
  - rename: {endmember: 1, name: red brick}
  - gloss: {endmember: 1, scale: 0}
  - gloss: {colour: ffcc00}
"""

endmembers = st.integers(0, 9) | st.from_regex(r"[a-zé][a-z _-]{0,8}[a-z]", fullmatch=True)
colours = st.tuples(*[st.integers(0, 255).map(lambda digit: digit / 255) | st.floats(0, 1)] * 3)
names = st.from_regex(r"[A-Za-zä][A-Za-z0-9_ -]{0,20}[a-z0-9]", fullmatch=True)
factors = st.floats(0, 1000)
several = st.lists(endmembers, min_size=1, max_size=3).map(tuple)
paths = names.map(lambda name: Path("/spectra") / name)
edits_to_be = st.one_of(
    st.builds(partial, st.just(Swap), endmembers, endmembers),
    st.builds(partial, st.just(Replace), endmembers, names, extrapolate=st.booleans()),
    st.builds(partial, st.just(Replace), endmembers, st.none(), paths, st.none() | names),
    st.builds(partial, st.just(Retint), endmembers, colours, st.sampled_from(["picture", "spectrum"])),
    st.builds(partial, st.just(Scale), endmembers, factors),
    st.builds(partial, st.sampled_from([Remove, Isolate]), several),
    st.builds(partial, st.just(Rename), endmembers, names),
    st.builds(partial, st.just(Gloss), st.none() | endmembers, factors, st.none() | colours),
)
"""Edits before they are made: the run-time checker of shapes draws at random, which a strategy must not."""

lights = st.builds(Light, st.sampled_from(["A", "D65", "FL2", Path("/lights/lamp.csv")]), st.booleans())


def fault_of(text: str) -> str:
    """The message with which a recipe is refused."""
    with pytest.raises(ConfigError) as caught:
        recipe_from_yaml(text, "edits.yml")
    return str(caught.value)


def test_every_edit_is_read_in_order_with_its_line(tmp_path):
    recipe = recipe_from_yaml(EVERY_EDIT, "edits.yml", tmp_path)
    assert recipe.illuminant == Light("D65")
    assert recipe.operations == (
        Swap("red", 3),
        Replace(2, "ColorChecker/red"),
        Replace("clay", None, tmp_path / "paints.csv", "ochre", extrapolate=True),
        Retint(4, (0x33 / 255, 0x66 / 255, 0xCC / 255)),
        Retint(5, (0.1, 0.25, 1.0), "spectrum"),
        Scale(0, 1.5),
        Remove((6,)),
        Isolate((7, "soil")),
        Rename(1, "red brick"),
        Gloss(1, 0.0),
        Gloss(colour=(1.0, 0.8, 0.0)),
    )
    assert [one.line for one in recipe.operations] == [4, 5, 6, 11, 12, 13, 14, 15, 16, 17, 18]
    assert recipe.where(3) == "edits.yml, line 11 (retint)"


@settings(deadline=None)
@given(st.lists(edits_to_be, max_size=5), st.none() | lights)
def test_reading_what_was_written_gives_the_same_recipe(edits, light):
    recipe = Recipe(tuple(edit() for edit in edits), light)
    text = recipe_to_yaml(recipe)
    assert recipe_from_yaml(text) == recipe
    assert set(yaml.safe_load(text)) <= {"edits", "illuminant"}


def test_files_lie_beside_the_recipe_that_names_them_and_it_may_be_written_elsewhere(tmp_path, monkeypatch):
    folder = tmp_path / "recipes"
    folder.mkdir()
    (folder / "edits.yml").write_text(
        "illuminant: lamp.csv\nedits:\n- replace: {endmember: 0, file: paint.csv}\n"
    )
    monkeypatch.chdir(tmp_path)
    recipe = read_recipe(Path("recipes/edits.yml"))
    assert recipe.illuminant == Light(folder / "lamp.csv")
    assert recipe.operations == (Replace(0, file=folder / "paint.csv"),)
    assert recipe.source == "recipes/edits.yml"
    here = Recipe((Replace(0, file=Path("paint.csv")),), Light(Path("lamp.csv")))
    (folder / "edits.yml").write_text(recipe_to_yaml(here))
    found = read_recipe(folder / "edits.yml")
    assert found.operations == (Replace(0, file=tmp_path / "paint.csv"),)
    assert found.illuminant == Light(tmp_path / "lamp.csv")


def test_a_recipe_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"can't read the recipe .*gone\.yml: No such file"):
        read_recipe(tmp_path / "gone.yml")
    (tmp_path / "latin.yml").write_bytes("edits: [rename: {endmember: 0, name: blé}]".encode("latin-1"))
    with pytest.raises(ConfigError, match=r"latin\.yml: it is not text in UTF-8"):
        read_recipe(tmp_path / "latin.yml")


WRONG = [
    ("", "edits.yml: the recipe is empty; it needs edits or an illuminant"),
    ("{}", "edits.yml, line 1: a recipe needs edits or an illuminant"),
    ("edit: []", "line 1: a recipe has no 'edit'; did you mean edits?"),
    ("edits:\n- swap: [0, 1\n", "line 3: not YAML"),
    ("edits: []\n---\nedits: []", "line 2: not YAML: but found another document"),
    ("edits: {swap: [0, 1]}", "line 1: edits must be a list; found a mapping"),
    ("edits:\n\n- swp: [0, 1]", "line 3: there is no edit 'swp'; did you mean swap?"),
    ("edits: [swap]", "an edit is one of swap, replace, retint, scale"),
    ("illuminant: D66", "line 1: illuminant: there is no light 'D66'; nearest: D65"),
    (
        "illuminant: [A]",
        "illuminant must be text, in quotes if it looks like something else; found a list of 1",
    ),
    ("illuminant:\n  {extrapolate: true}", "line 2: illuminant needs light"),
    ("edits: " + 3000 * "[", "not YAML"),
    ("edits: [\x00]", "not YAML"),
    ("%YAML " + 5000 * "1" + ".1\n---\nedits: []", "not YAML"),
    ('edits: ["\\UFFFFFFFF"]', "not YAML"),
    ("#" * 100_001, "100001 characters are too many"),
    ("edits:" + 1001 * "\n- remove: 0", "line 2: edits has 1001 items; at most 1000"),
]
WRONG_EDITS = [
    ("swap: [0, 1, 2]", "line 2: swap takes a list of 2; found 3"),
    ("swap: [0, true]", "line 2: an endmember must be given by its name or number; found 'true'"),
    ("swap: [0, 1.5]", "found '1.5'"),
    ("swap: [0, !!python/name:os.system x]", "only plain data is read"),
    ("swap: [0, !!python/object/apply:os.getcwd []]", "an endmember must be given by its name or number"),
    ("remove: []", "line 2: remove: no endmember is given"),
    ("remove: [" + 256 * "0," + "]", "remove has 256 items; at most 255"),
    ("remove: 1:30", "line 2: can't read '1:30' as a number"),
    ("scale: {endmember: 1}", "line 2: scale needs factor"),
    ("scale: {endmember: 1, factor: 2,\n    factor: 3}", "line 3: scale has 'factor' twice"),
    ("scale: {endmember: 1, factr: 2}", "scale has no 'factr'; did you mean factor?"),
    ("scale: {endmember: 1, factor: bright}", "factor must be a number; found 'bright'"),
    ("scale: {endmember: 1, factor: -1}", "factor must be a number from 0 to 1000; found -1.0"),
    ("scale: {endmember: 1, factor: .nan}", "a number from 0 to 1000; found nan"),
    ("scale: {endmember: 0, factor: !!bool maybe}", "line 2: can't read 'maybe' as bool"),
    ("scale: {endmember: 0, factor: !!float ''}", "line 2: can't read nothing as float"),
    ("scale: {endmember: 0, factor: " + 400 * "9" + "}", "line 2: can't read '9999"),
    ("retint: {endmember: 1, colour: '#12345'}", "must be '#rrggbb' in quotes"),
    ("retint:\n    endmember: 1\n    colour: #1234", "line 4: colour must be .*# begins a comment"),
    ("retint: {endmember: 1, colour: [0, 0, 2]}", "values in [0, 1]; found [0.0, 0.0, 2.0]"),
    ("retint: {endmember: 1, colour: [0, 0]}", "found 2 numbers"),
    ("retint: {endmember: 1, colour: 112233, match: x}", "found '112233'"),
    ("retint: {endmember: 1, colour: '112233', match: x}", "must be picture or spectrum; found 'x'"),
    ("rename: {endmember: 1, name: 'a,b'}", "a name has at most 40 letters, digits"),
    ("rename: {endmember: 1, name: 7}", "name must be text, in quotes if .*; found '7'"),
    ("rename: {endmember: 1, name: '7'}", "starts with a letter; found '7'"),
    ("gloss: {endmember: 1}", "gloss needs scale or colour"),
    ("replace: {endmember: 1}", "replace: give either library or file"),
    ("replace: {endmember: 1, library: a, file: b}", "replace: give either library or file"),
    ("replace: {endmember: 1, library: a, spectrum: b}", "line 2: replace: spectrum goes with file"),
    ("replace: {endmember: 1, file: a, extrapolate: 3}", "must be true or false; found '3'"),
    ("replace: {endmember: 0, library: 2026-99-99}", "can't read '2026-99-99' as timestamp"),
    ('replace: {endmember: 0, file: "a\\0b"}', "line 2: file has a character that no name"),
    ('replace: {endmember: 0, file: "\\ud800"}', "line 2: file has a character that no name"),
]


@pytest.mark.parametrize(
    ("text", "message"), [*WRONG, *((f"edits:\n- {edit}", message) for edit, message in WRONG_EDITS)]
)
def test_what_is_wrong_is_said_with_its_line(text, message):
    fault = fault_of(text)
    assert all(line.startswith("edits.yml") for line in fault.splitlines())
    assert re.search(message, fault) if ".*" in message else message in fault


def test_one_message_names_every_fault():
    fault = fault_of("edits:\n- swap: [0]\n- scale: {endmember: 1, factor: 2}\n- remove: {}\n- vanish: 1\n")
    assert [line.split(":")[0] for line in fault.splitlines()] == [f"edits.yml, line {n}" for n in (2, 4, 5)]


def test_a_recipe_of_the_greatest_size_is_read_in_time_and_aliases_do_not_multiply_it():
    """An alias costs as much as what it repeats: the limits on both bound the product."""
    many = ", ".join(["7"] * 255)
    text = f"edits:\n- remove: &all [{many}]\n" + 999 * "- remove: *all\n"
    started = time.process_time()
    recipe = recipe_from_yaml(text)
    assert time.process_time() - started < 20  # seconds of computing; as measured: 2
    assert len(recipe.operations) == 1000
    assert recipe.operations[-1] == Remove((7,) * 255)
    assert "not YAML" in (fault := fault_of("edits: &a [*a]")) or "an edit is one of" in fault


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (Retint, (1, (0.0, 0.0, 0.0), None)),
        (Retint, (1, None)),
        (Scale, (1, None)),
        (Rename, (1, None)),
        (Replace, (None, "x/y")),
    ],
)
def test_an_edit_made_in_python_without_a_value_is_refused(kind: Any, values):
    with pytest.raises((ConfigError, TypeError)):  # of a checker of types, where one runs
        kind(*values)
