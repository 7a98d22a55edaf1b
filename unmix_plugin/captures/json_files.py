"""JSON files of a capture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
