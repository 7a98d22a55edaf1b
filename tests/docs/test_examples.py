"""examples/: a file for each that a page asks users for; every one is read, and a broken one is refused by name."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from unmix_plugin.editing.apply import relighting_factors
from unmix_plugin.editing.recipe import Light, Replace
from unmix_plugin.editing.recipe_files import read_recipe
from unmix_plugin.errors import UnmixError
from unmix_plugin.formats.libraries import read_library
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.maps.targets import parse_target
from unmix_plugin.spectral.sensor import read_sensor

EXAMPLES = Path(__file__).parents[2] / "examples"
BANDS = Bands.of(np.arange(400, 1001, 10))
READ: dict[str, Callable[[Path], object]] = {
    "paint.csv": lambda path: parse_target(f"ace:{path}", BANDS, read_library),
    "paints.csv": lambda path: parse_target(f"mf:{path}#cobalt", BANDS, read_library),
    "responses.csv": read_sensor,
    "lamp.csv": lambda path: relighting_factors(BANDS, None, Light(path)),
    "edits.yml": read_recipe,
}
BROKEN = {
    "paint.csv": [
        ("0.220", "22.0%", "22.0%"),
        ("wavelength", "colour", "wavelength"),
        ("360,", "nan,", "nan"),
    ],
    "paints.csv": [("cobalt", "gold", "gold"), ("cobalt", "blue", "cobalt"), ("0.378", "abc", "abc")],
    "responses.csv": [("0.20", "-0.2", "-0.2"), ("green", "blue", "blue"), ("470,", "x,", "x")],
    "lamp.csv": [
        ("power", "power,other", "line 2 has 2 values, the header has 3"),
        ("380,", "380 ,,", "line 3 has 3 values, the header has 2"),
        ("360,", "-360,", "-360"),
    ],
    "edits.yml": [
        ("{endmember: 2, name: wood}", "{endmember: 2}", "line 4"),
        ("'#3366cc'", "'#33'", "line 6"),
        ("remove: [4]", "delete: [4]", "line 7"),
        ("D65", "D66", "line 2"),
    ],
}


def test_every_file_for_users_is_read():
    assert {path.name for path in EXAMPLES.iterdir() if path.suffix != ".py"} == {*READ} == {*BROKEN}
    for name, read in READ.items():
        read(EXAMPLES / name)
    replaced = next(one for one in read_recipe(EXAMPLES / "edits.yml").operations if isinstance(one, Replace))
    assert replaced.file == EXAMPLES / "paints.csv"
    assert [one.name for one in read_library(EXAMPLES / "paints.csv")] == ["gold", "cobalt", "ochre"]


@pytest.mark.parametrize(
    ("name", "good", "bad", "said"),
    [(name, *change) for name, changes in BROKEN.items() for change in changes],
)
def test_a_broken_one_is_refused_by_its_name_and_what_was_found(name, good, bad, said, tmp_path):
    folder = tmp_path / "examples"
    shutil.copytree(EXAMPLES, folder)
    text = (folder / name).read_text()
    assert good in text
    (folder / name).write_text(text.replace(good, bad, 1))
    with pytest.raises(UnmixError, match=re.escape(said)) as refused:
        READ[name](folder / name)
    assert name in str(refused.value)
