"""JSON and XML of unknown origin, and numbers in XML."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from unmix_plugin.errors import CaptureError
from unmix_plugin.scenes.reading.faults import UnreadableJsonError, read_json_file


def load_json(path: Path) -> Any:
    """What the file holds.

    Raises:
        CaptureError: it can't be read, or is no JSON.
    """
    try:
        return read_json_file(path)
    except UnreadableJsonError as error:
        raise CaptureError(f"{path} {error}") from error
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error


def load_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file.

    Raises:
        CaptureError: it can't be read, is no XML, or declares entities, which could grow without end.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CaptureError(f"{path} can't be read ({error.strerror or error})") from error
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise CaptureError(f"{path} declares a DOCTYPE or entities; expected plain XML: export it again")
    try:
        return ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # LookupError: an unknown encoding
        raise CaptureError(f"{path} is not valid XML ({error}); was it cut short?") from error


def numbers_of(
    element: ElementTree.Element | None, count: int, where: str
) -> Float64[np.ndarray, " count"] | None:
    """Numbers in the text of an element; None without an element or text.

    Raises:
        CaptureError: they are not as many finite numbers.
    """
    if element is None or not (element.text or "").strip():
        return None
    texts = (element.text or "").split()
    try:
        values = np.array([float(text) for text in texts])
    except ValueError:
        values = np.full(count, np.nan)
    if len(texts) != count or not np.isfinite(values).all():
        raise CaptureError(
            f"{where}: <{element.tag}> holds {' '.join(texts)[:60]!r}; expected {count} finite numbers: is it damaged?"
        )
    return values


def number_of(parent: ElementTree.Element, tag: str, where: str, default: float = 0.0) -> float:
    """The number in a child; the default without one."""
    values = numbers_of(parent.find(tag), 1, where)
    return default if values is None else float(values[0])
