"""What comes from a browser is made harmless; nothing that a user typed is ever markup."""

import math
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.paint import ColourScale
from unmix_plugin.formats.files import write_file
from unmix_plugin.spectral.intervals import Interval
from unmix_plugin.viewer import page
from unmix_plugin.viewer.page import Debounced, choice, new_file, number, text
from unmix_plugin.viewer.rendering.painting import legend_html

anything = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.lists(st.integers()), st.binary()
)


@given(anything)
def test_numbers_choices_and_texts_are_always_within_bounds(value):
    found = number(value, -2.0, 3.0, fallback=0.5)
    assert math.isfinite(found)
    assert -2 <= found <= 3
    assert choice(value, ("a", "b"), "a") in ("a", "b")
    assert choice("b", ("a", "b"), "a") == "b"
    assert isinstance(text(value), str)
    assert len(text("x" * 200_000)) == 100_000


@given(st.text(max_size=300))
def test_a_file_lies_in_its_folder_whatever_it_is_called(name):
    path = new_file(Path("/somewhere/run"), name, ".png", "view")
    assert (path.parent, path.suffix) == (Path("/somewhere/run"), ".png")
    assert not path.name.startswith(".")
    assert len(path.name.encode()) < 120


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
        ("Bl\u00e4tter", "Bl\u00e4tter.png"),
        ("nul", "_nul.png"),
    ],
)
def test_names_are_kept_as_far_as_they_are_safe(tmp_path, name, expected):
    assert new_file(tmp_path, name, ".png", "view").name == expected


def test_no_file_is_ever_overwritten_and_endless_files_of_one_name_are_refused(tmp_path, monkeypatch):
    for expected in ("shot.png", "shot-2.png", "shot-3.png"):
        path = new_file(tmp_path, "shot", ".png", "view")
        assert path.name == expected
        assert path.read_bytes() == b""  # which claims the name
    monkeypatch.setattr("unmix_plugin.viewer.page.claim", lambda _: False)
    with pytest.raises(ConfigError, match="too many files named shot"):
        new_file(tmp_path, "shot", ".png", "view")


def test_pages_that_save_at_once_get_files_of_their_own(tmp_path):
    def save(number):
        for index in range(5):
            content = f"{number} {index}".encode() * 1000
            write_file(new_file(tmp_path, "recipe", ".yml", "recipe"), content)

    with ThreadPoolExecutor(5) as pool:
        list(pool.map(save, range(5)))
    found = {path.read_bytes()[:3] for path in tmp_path.glob("[!.]*")}
    assert found == {f"{number} {index}".encode() for number in range(5) for index in range(5)}
    assert len(list(tmp_path.glob("[!.]*"))) == 25


def test_work_is_done_once_after_the_last_event_or_at_once_if_there_is_some():
    done = []
    field = Debounced(lambda: done.append(1))
    field.tick(at_once=True)
    for _ in range(5):
        field.note()
        field.tick()
    assert (done, field.is_waiting) == ([], True)
    field.tick()
    field.tick()
    assert (done, field.is_waiting) == ([1], False)
    field.note()
    field.tick(at_once=True)
    field.tick()
    assert done == [1, 1]


EVIL = "<script>alert(1)</script><img src=x onerror='alert(2)'> & \"quotes\""


class Collector(HTMLParser):
    """Tags and text of a page, and whether every tag is closed."""

    def __init__(self, content):
        super().__init__()
        self.tags, self.text, self.open = [], "", []
        self.feed(content)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize(
    "content",
    [
        page.paragraph(EVIL),
        page.paragraph(EVIL, is_warning=True),
        page.bars([(EVIL, 0.5, (1.0, 0.0, 0.0))]),
        page.table([(EVIL, EVIL)]),
        legend_html(EVIL),
        legend_html(((EVIL, (0.1, 0.2, 0.3)),)),
        legend_html(ColourScale("viridis", 0.0, 1.0, EVIL)),
        page.swatches([(EVIL, (0.0, 0.0, 0.0))]),
    ],
)
def test_words_of_users_are_shown_and_never_run(content):
    found = Collector(content)
    assert not {"script", "img"} & set(found.tags)
    assert EVIL in found.text


def test_a_colour_bar_says_its_values_and_bars_are_as_long_as_theirs_and_never_longer_than_the_panel():
    content = legend_html(ColourScale("gray", -1.0, 3.0, "radiance"))
    assert all(value in Collector(content).text for value in ("-1", "1", "3", "radiance"))
    assert "#000000" in content
    assert "#ffffff" in content
    red = (1.0, 0.0, 0.0)
    content = page.bars([("a", 0.25, red), ("b", 7.0, red), ("c", -1.0, red)])
    assert all(f"width:{width}" in content for width in ("25.0%", "100.0%", "0.0%"))


def test_bars_say_the_interval_of_each_value_or_why_there_is_none():
    red, low, high = (1.0, 0.0, 0.0), np.array([0.1, 0.6]), np.array([0.4, 0.8])
    entries = [("a", 0.25, red), ("b", 0.75, red)]
    found = Collector(page.bars(entries, Interval(low, high, 0.9))).text
    assert found.index("b") < found.index("0.60 to 0.80") < found.index("0.10 to 0.40")
    untold = page.bars(entries, Interval.unknown(low, 0.9, EVIL))
    assert not {"script", "img"} & set(Collector(untold).tags)
    assert "not determined" in Collector(untold).text


def test_a_message_that_is_logged_steers_no_terminal(caplog):
    def gone(_message):
        raise RuntimeError("the page has gone")

    with page.reporting_failures("that failed\x1b[2J", gone):
        raise OSError(2, "no such file", "view\x1b]0;x\x07.npy")
    assert len(caplog.messages) == 2
    assert "Traceback" in caplog.text
    assert not any(letter in message for message in caplog.messages for letter in "\x1b\x07")
