"""The report as one HTML file that holds everything it shows: no script, no font, no request."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from unmix_plugin.figures.plotting import LineChart, css_colour, draw_chart

_LARGEST_SIDE_PX = 640
"""Larger pictures are shrunk, as a page would show them."""


def render_page(values: Mapping[str, Any]) -> str:
    """The template filled in; text is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("unmix_plugin.products.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters |= {"css": css_colour, "png": png_url, "svg": svg_url}
    return environment.get_template("report.html").render(values)


def png_url(image: Float[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W 3"]) -> str:
    """An sRGB picture, in [0, 1] or 8-bit, as a URL with the picture in it; large ones are shrunk."""
    from PIL import Image

    is_float = np.issubdtype(image.dtype, np.floating)
    pixels = Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8) if is_float else image)
    longest = max(pixels.size)
    if longest > _LARGEST_SIDE_PX:
        size = [max(1, round(side * _LARGEST_SIDE_PX / longest)) for side in pixels.size]
        pixels = pixels.resize((size[0], size[1]), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    pixels.save(buffer, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def svg_url(chart: LineChart) -> str:
    """A chart as a URL with the drawing in it."""
    return f"data:image/svg+xml;base64,{base64.b64encode(draw_chart(chart)).decode()}"
