"""Looks at a built site: `python scripts/check_site.py FOLDER`. Exit status 1, and a line for each fault:

links and pictures that lead nowhere, anything that a page would load from another server, and pages that are more
than two clicks from the front page, by links in the text of pages alone.
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

_LOADS = {"script": "src", "img": "src", "source": "src", "video": "src", "iframe": "src", "link": "href"}
_MADE = ("genindex.html", "search.html", "py-modindex.html", "404.html")
"""Pages that the theme makes, which its own search and footer lead to."""


class Page(HTMLParser):
    """What a page links to and loads; `in_text` are links of its article."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.in_text: set[str] = set()
        self.loads: set[str] = set()
        self.anchors: set[str] = set()
        self._depth = 0
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collects."""
        found = {name: value for name, value in attrs if value}
        if "id" in found:
            self.anchors.add(found["id"])
        self._depth += tag == "article"
        if tag == "a" and "href" in found:
            self.links.add(found["href"])
            if self._depth:
                self.in_text.add(found["href"])
        if (
            tag in _LOADS
            and _LOADS[tag] in found
            and found.get("rel") not in ("canonical", "index", "search", "next", "prev")
        ):
            self.loads.add(found[_LOADS[tag]])

    def handle_endtag(self, tag: str) -> None:
        """Leaves the text."""
        self._depth -= tag == "article"


def faults_of(folder: Path) -> list[str]:
    """A line for each fault of the site in a folder."""
    pages = {path: Page(path) for path in sorted(folder.rglob("*.html")) if "_static" not in path.parts}
    faults = []
    for path, page in pages.items():
        name = path.relative_to(folder)
        faults += [
            f"{name} loads {target} from another server"
            for target in sorted(page.loads)
            if urlsplit(target).scheme not in ("", "data") or target.startswith("//")
        ]
        for target in sorted(page.links | page.loads):
            if urlsplit(target).scheme or target.startswith("//"):
                continue
            place, anchor = _target(path, target)
            if not place.exists():
                faults.append(f"{name} links to {target}, which is not there")
            elif anchor and place in pages and anchor not in pages[place].anchors:
                faults.append(f"{name} links to {target}, a heading that is not there")
    far = set(pages) - _within(pages, folder / "index.html", 2)
    faults += [
        f"{path.relative_to(folder)} is more than two clicks from the front page"
        for path in sorted(far)
        if path.name not in _MADE
    ]
    for sheet in folder.rglob("*.css"):
        text = sheet.read_text(encoding="utf-8")
        if "url(http" in text or "url(//" in text or "@import" in text:
            faults.append(f"{sheet.relative_to(folder)} loads from another server")
    return faults


def _target(path: Path, target: str) -> tuple[Path, str]:
    """The file and the heading that a link of a page leads to."""
    parts = urlsplit(target)
    place = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    return (place / "index.html" if place.is_dir() else place), unquote(parts.fragment)


def _within(pages: dict[Path, Page], start: Path, clicks: int) -> set[Path]:
    reached = {start}
    for _ in range(clicks):
        targets = {
            _target(path, link)[0]
            for path in reached
            for link in pages[path].in_text
            if not urlsplit(link).scheme
        }
        reached |= targets & set(pages)
    return reached


def main() -> None:
    """Console entry."""
    folder = Path(sys.argv[1]).resolve()
    faults = faults_of(folder)
    print(*faults, sep="\n", end="\n" if faults else "")
    if faults:
        sys.exit(1)
    print(f"site: {folder / 'index.html'}")


if __name__ == "__main__":
    main()
