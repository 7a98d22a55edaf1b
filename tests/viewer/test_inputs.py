"""What comes from a browser is made harmless."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer import page as inputs
from unmix_plugin.viewer.page import choice, new_file, number, text

anything = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.lists(st.integers()), st.binary()
)


@given(anything)
def test_a_number_is_always_finite_and_within_bounds(value):
    found = number(value, -2.0, 3.0, fallback=0.5)
    assert math.isfinite(found)
    assert -2 <= found <= 3


@given(anything)
def test_a_choice_is_always_a_known_one(value):
    assert choice(value, ("a", "b"), "a") in ("a", "b")
    assert choice("b", ("a", "b"), "a") == "b"


@given(anything)
def test_a_text_is_always_a_text_of_bounded_length(value):
    assert isinstance(text(value), str)
    assert len(text("x" * 200_000)) == inputs.LONGEST_TEXT


@given(st.text(max_size=300))
def test_a_file_lies_in_its_folder_whatever_it_is_called(name):
    folder = Path("/somewhere/run")
    path = new_file(folder, name, ".png", "view")
    assert path.parent == folder
    assert path.suffix == ".png"
    assert path.name not in (".png", "..png")
    assert not path.name.startswith(".")
    assert path.name.isascii()
    assert len(path.name) < 100


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("../../etc/passwd", "etc_passwd.png"),
        ("/absolute", "absolute.png"),
        ("a b", "a_b.png"),
        ("shot.png", "shot.png"),
        ("", "view.png"),
        (None, "view.png"),
        ("..", "view.png"),
        ("v1.2", "v1.2.png"),
    ],
)
def test_names_are_kept_as_far_as_they_are_safe(tmp_path, name, expected):
    assert new_file(tmp_path, name, ".png", "view").name == expected


def test_no_file_is_ever_overwritten(tmp_path):
    for expected in ("shot.png", "shot-2.png", "shot-3.png"):
        path = new_file(tmp_path, "shot", ".png", "view")
        assert path.name == expected
        path.touch()


def test_endless_files_of_one_name_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(Path, "exists", lambda _: True)
    with pytest.raises(ConfigError, match="too many files named shot"):
        new_file(tmp_path, "shot", ".png", "view")
