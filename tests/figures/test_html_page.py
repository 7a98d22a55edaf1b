import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from unmix_plugin.figures.html_page import Section, facts, picture, render_page, table

VOID = {"meta", "img", "br", "line"}


class Outline(HTMLParser):
    """Checks that every element is closed in its place; keeps what a browser would fetch."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        self.fetched += [
            values[name] for name in ("src", "srcset", "data", "action", "poster") if name in values
        ]
        self.ids += [values["id"]] if "id" in values else []
        if tag == "a":
            self.links.append(values["href"])
        assert tag not in ("script", "iframe", "object", "embed", "base", "form")
        assert not any(name.startswith("on") for name in values)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def assert_self_contained(page: str) -> Outline:
    """The page is well-formed and fetches nothing; its links lead into itself."""
    outline = Outline(page)
    assert all(source.startswith("data:image/png;base64,") for source in outline.fetched)
    assert {link.removeprefix("#") for link in outline.links} <= set(outline.ids)
    assert not re.search(r"url\(|@import|https?://", page)
    assert "default-src 'none'" in page
    return outline


def test_a_page_is_well_formed_self_contained_and_links_to_its_sections():
    sections = [Section("one", "One & only", "<p>text</p>"), Section("two", "Two", facts([("a", "b")]))]
    outline = assert_self_contained(render_page("Title <x>", "sub", sections))
    assert outline.ids == ["one", "two"]
    assert outline.links == ["#one", "#two"]
    assert "Title <x>" in outline.text
    assert "One & only" in outline.text


def test_text_in_tables_and_facts_is_escaped():
    hostile = '<img src="http://example.org/x.png">'
    page = render_page(
        "t", "s", [Section("a", "A", table([hostile], [[hostile]]) + facts([(hostile, hostile)]))]
    )
    outline = Outline(page)
    assert outline.fetched == []
    assert outline.text.count(hostile) == 4


def decoded(html: str) -> np.ndarray:
    found = re.search(r'src="data:image/png;base64,([^"]+)"', html)
    assert found is not None
    with Image.open(io.BytesIO(base64.b64decode(found[1]))) as image:
        return np.asarray(image)


def test_a_picture_holds_its_pixels():
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3))
    np.testing.assert_array_equal(decoded(picture(pixels / 255, "alternative")), pixels)


@pytest.mark.parametrize(("size", "expected"), [((10, 1280), (5, 640)), ((2000, 1), (640, 1))])
def test_a_large_picture_is_shrunk(size, expected):
    assert decoded(picture(np.zeros((*size, 3)), "x")).shape[:2] == expected


def test_pictures_say_what_they_show():
    assert 'alt="a &quot;view&quot;"' in picture(np.zeros((2, 2, 3)), 'a "view"')
