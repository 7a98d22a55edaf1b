"""Pages of HTML that hold everything they show: no script, no font, no request, whatever opens them.

Functions give HTML; text that goes in is escaped by them unless an argument says that it is HTML already.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from jaxtyping import Float

_LARGEST_SIDE_PX = 640
"""Of a picture: larger ones are shrunk, which a page shows anyway."""

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""What a browser may load: nothing but what the page has in it."""


@dataclass(frozen=True)
class Section:
    """A part of a page."""

    key: str
    """For links: letters, digits and dashes."""
    title: str
    html: str


def render_page(title: str, subtitle: str, sections: Sequence[Section]) -> str:
    """A whole page, with links to its sections."""
    links = "".join(f'<a href="#{one.key}">{escape(one.title)}</a>' for one in sections)
    body = "\n".join(
        f'<section id="{one.key}">\n<h2>{escape(one.title)}</h2>\n{one.html}\n</section>' for one in sections
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{_STYLE}</style>
</head>
<body>
<header>
<h1>{escape(title)}</h1>
<p class="subtitle">{escape(subtitle)}</p>
<nav>{links}</nav>
</header>
<main>
{body}
</main>
</body>
</html>
"""


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph."""
    return f"<p{_class(kind)}>{escape(text)}</p>"


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    numeric: Sequence[int] = (),
    cells_are_html: bool = False,
) -> str:
    """A table.

    Args:
        head: Names of the columns; none: no head.
        rows: Cells.
        numeric: Columns that stand to the right.
        cells_are_html: Whether cells are HTML already.
    """

    def row(cells: Sequence[str], tag: str, is_html: bool) -> str:
        return "".join(
            f"<{tag}{_class('number' if column in numeric else '')}>{cell if is_html else escape(cell)}</{tag}>"
            for column, cell in enumerate(cells)
        )

    body = "\n".join(f"<tr>{row(cells, 'td', cells_are_html)}</tr>" for cells in rows)
    top = f"<thead><tr>{row(head, 'th', False)}</tr></thead>" if head else ""
    return f'<div class="wide"><table>{top}<tbody>{body}</tbody></table></div>'


def facts(pairs: Sequence[tuple[str, str]]) -> str:
    """Names and values side by side."""
    body = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="facts">{body}</dl>'


def details(summary: str, html: str) -> str:
    """Something that opens on a click; printed open."""
    return f"<details><summary>{escape(summary)}</summary>{html}</details>"


def preformatted(text: str) -> str:
    """Text as it is."""
    return f"<pre>{escape(text)}</pre>"


def swatch(srgb: Float[np.ndarray, "3"]) -> str:
    """A small square of a colour."""
    return f'<span class="swatch" style="background:{css_colour(srgb)}"></span>'


def css_colour(srgb: Float[np.ndarray, "3"]) -> str:
    """An sRGB colour in [0, 1] as CSS has it.

    >>> css_colour(np.array([1.0, 0.5, 0.0]))
    '#ff8000'
    """
    return "#" + "".join(f"{round(255 * min(max(value, 0.0), 1.0)):02x}" for value in srgb.tolist())


def picture(image: Float[np.ndarray, "H W 3"], alternative: str) -> str:
    """An sRGB picture in [0, 1]; pixels stay sharp, and large ones are shrunk."""
    from PIL import Image

    pixels = Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
    longest = max(pixels.size)
    if longest > _LARGEST_SIDE_PX:
        factor = _LARGEST_SIDE_PX / longest
        size = (max(1, round(factor * pixels.width)), max(1, round(factor * pixels.height)))
        pixels = pixels.resize(size, Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    pixels.save(buffer, format="PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<img src="data:image/png;base64,{data}" width="{pixels.width}" height="{pixels.height}" '
        f'alt="{escape(alternative, quote=True)}">'
    )


def figure(html: str, caption_html: str) -> str:
    """A picture or a chart with a line below it; both HTML already."""
    return f"<figure>{html}<figcaption>{caption_html}</figcaption></figure>"


def figures(items: Sequence[str], columns: int) -> str:
    """Figures in a grid."""
    return f'<div class="grid-{columns}">{"".join(items)}</div>'


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""


_STYLE = """
:root { color-scheme: light; --ink: #1c2024; --soft: #5d6670; --line: #dfe3e8; --paper: #ffffff; --tint: #f5f7f9;
  --link: #0b5cad; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); line-height: 1.5;
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
header, main { max-width: 1120px; margin: 0 auto; padding: 0 24px; }
header { padding-top: 36px; }
h1 { font-size: 28px; line-height: 1.2; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 20px; margin: 0 0 12px; }
h3 { font-size: 15px; margin: 18px 0 8px; }
.subtitle { color: var(--soft); margin: 0 0 18px; overflow-wrap: anywhere; }
nav { display: flex; flex-wrap: wrap; gap: 4px 18px; padding: 10px 0; border-top: 1px solid var(--line);
  border-bottom: 1px solid var(--line); }
nav a { color: var(--link); text-decoration: none; }
nav a:hover { text-decoration: underline; }
section { padding: 28px 0 8px; }
p { margin: 0 0 12px; max-width: 78ch; }
.note { color: var(--soft); }
.warning { border-left: 4px solid #d99a00; background: #fff8e6; padding: 8px 12px; }
.wide { overflow-x: auto; margin-bottom: 14px; }
table { border-collapse: collapse; width: 100%; }
th, td { text-align: left; padding: 6px 12px 6px 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; white-space: nowrap; }
.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
td.number + td, th.number + th { padding-left: 12px; }
.facts { display: grid; grid-template-columns: repeat(auto-fill, minmax(210px, 1fr)); gap: 10px; margin: 0 0 14px; }
.facts div { background: var(--tint); border-radius: 6px; padding: 9px 12px; }
.facts dt { color: var(--soft); font-size: 13px; }
.facts dd { margin: 0; font-weight: 600; overflow-wrap: anywhere; }
figure { margin: 0; min-width: 0; }
figcaption { font-size: 13px; color: var(--soft); padding-top: 4px; }
img { display: block; width: 100%; height: auto; image-rendering: pixelated; border: 1px solid var(--line);
  border-radius: 3px; }
[class^="grid-"] { display: grid; gap: 14px 12px; margin-bottom: 16px; align-items: start; }
.grid-2 { grid-template-columns: repeat(2, minmax(0, 1fr)); }
.grid-3 { grid-template-columns: repeat(3, minmax(0, 1fr)); }
.grid-4 { grid-template-columns: repeat(4, minmax(0, 1fr)); }
.grid-5 { grid-template-columns: repeat(5, minmax(0, 1fr)); }
.grid-6 { grid-template-columns: repeat(6, minmax(0, 1fr)); }
.grid-7 { grid-template-columns: repeat(7, minmax(0, 1fr)); }
.card { border: 1px solid var(--line); border-radius: 8px; padding: 14px 16px 6px; }
.card h3 { margin: 0 0 6px; display: flex; flex-wrap: wrap; align-items: center; gap: 0 8px;
  overflow-wrap: anywhere; }
.card h3 .note { font-weight: 400; }
.card td, .card th { font-size: 13px; padding: 4px 8px 4px 0; }
.swatch { display: inline-block; width: 14px; height: 14px; border: 1px solid #6b747d; border-radius: 3px; flex: none;
  vertical-align: -2px; margin-right: 6px; }
.legend { display: flex; flex-wrap: wrap; gap: 2px 16px; font-size: 13px; margin: 4px 0 10px; }
.key { display: inline-flex; align-items: center; gap: 6px; }
.bar { display: flex; align-items: center; gap: 8px; font-size: 13px; color: var(--soft); margin: 0 0 14px; }
.bar img { width: 220px; height: 12px; border-radius: 2px; }
svg.chart { display: block; width: 100%; height: auto; }
svg .grid { stroke: #e9ecf0; stroke-width: 1; }
svg .axis { stroke: #8a939c; stroke-width: 1; }
svg .tick { font-size: 12px; fill: #5d6670; }
svg .label { font-size: 13px; fill: #1c2024; }
details { border: 1px solid var(--line); border-radius: 6px; padding: 8px 12px; margin-bottom: 10px; }
summary { cursor: pointer; font-weight: 600; }
pre { font: 12.5px/1.45 ui-monospace, "SF Mono", Menlo, Consolas, monospace; white-space: pre-wrap;
  overflow-wrap: anywhere; margin: 8px 0 0; }
@media screen and (max-width: 760px) {
  .grid-2, .grid-3 { grid-template-columns: minmax(0, 1fr); }
  .grid-4 { grid-template-columns: repeat(2, minmax(0, 1fr)); }
  .grid-5, .grid-6, .grid-7 { grid-template-columns: repeat(3, minmax(0, 1fr)); }
}
@media print {
  @page { margin: 14mm; }
  body { font-size: 10.5pt; -webkit-print-color-adjust: exact; print-color-adjust: exact; }
  header, main { max-width: none; padding: 0; }
  nav { display: none; }
  h2, h3, .bar, section > p { break-after: avoid; }
  p, figure, .card, tr, .facts div { break-inside: avoid; }
  section { padding: 14px 0 4px; }
  .wide { overflow: visible; }
  details::details-content { content-visibility: visible; height: auto; }
}
"""
