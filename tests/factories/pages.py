"""What is on the pages of the documentation, and in a page of HTML as a browser would read it."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

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
        self.section_texts: dict[str, str] = {}
        """Text of each section, by its id."""
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        values = {name: value or "" for name, value in attrs}
        fetching = ("src", "srcset", "data", "action", "poster")
        self.fetched += [values[name] for name in fetching if name in values]
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
        if "section" in self.open:
            self.section_texts[self.ids[-1]] = self.section_texts.get(self.ids[-1], "") + data


def assert_self_contained(page: str) -> Outline:
    """The page is well-formed and fetches nothing; its links lead into itself, or to the exported 3-D page."""
    outline = Outline(page)
    kinds = ("data:image/png;base64,", "data:image/svg+xml;base64,")
    assert all(source.startswith(kinds) for source in outline.fetched)
    assert {link.removeprefix("#") for link in outline.links} <= {*outline.ids, "../page/page.html"}
    assert not re.search(r"url\(|@import|https?://", page)
    assert "default-src 'none'" in page
    return outline


ROOT = Path(__file__).parents[2]


def text_of(page: str) -> str:
    """A page of the repository."""
    return (ROOT / page).read_text(encoding="utf-8")


def blocks_of(page: str, language: str) -> list[str]:
    """The blocks of code of a page in a language ("" for none)."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", text_of(page), flags=re.DOTALL | re.MULTILINE)
    return [code for name, code in found if name == language]
