"""Pages in one HTML file, which hold all that they show."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from unmix_plugin.formats.files import eight_bits


def fill_template(
    package: str,
    name: str,
    values: Mapping[str, Any],
    filters: Mapping[str, Callable[..., Any]] | None = None,
) -> str:
    """A template in a package's folder, filled in; text is escaped, and a value that is missing is an error.

    `VALUE | tojson` is JSON that may stand in a script element, whatever the names in it.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader(package, "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    environment.filters |= filters or {}
    return environment.get_template(name).render(values)


def picture_url(image: Float[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W 3"], largest_side_px: int) -> str:
    """An sRGB picture, in [0, 1] or 8-bit, as a URL with the picture in it; larger ones are shrunk."""
    from PIL import Image

    is_float = np.issubdtype(image.dtype, np.floating)
    pixels = Image.fromarray(eight_bits(image) if is_float else image)
    longest = max(pixels.size)
    if longest > largest_side_px:
        size = [max(1, round(side * largest_side_px / longest)) for side in pixels.size]
        pixels = pixels.resize((size[0], size[1]), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    pixels.save(buffer, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"
