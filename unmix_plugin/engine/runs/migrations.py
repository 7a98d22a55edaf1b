"""Files of runs as older versions of this package wrote them, brought to the present format one step after the other.

A run of format 7 opens in every later version. A step takes the values of any JSON file of a run (it looks for what it
changes) and gives those of the next format; it stays as it is for ever, so what it fills in is written out here and not
taken from settings, whose defaults may change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

OLDEST_FORMAT = 7


def migrated(values: dict[str, Any], to: int) -> dict[str, Any]:
    """The values of a file in a later format."""
    for version in range(values["format_version"], to):
        values = {**_STEPS[version](values), "format_version": version + 1}
    return values


def _with_first_smallest_weight(values: dict[str, Any]) -> dict[str, Any]:
    """Format 8: what was `auto` and follows from the scene stands as a value in config.json, as the model settles it
    when it is opened; and the renderer's weight at the start of training is a setting of its own."""
    model = _at(values, "config", "pipeline", "model")
    renderer = _at(model, "renderer")
    if "smallest_weight" not in renderer:
        return values
    filled = {**model, "renderer": {"first_smallest_weight": "auto", **renderer}}
    pipeline = {**values["config"]["pipeline"], "model": filled}
    return {**values, "config": {**values["config"], "pipeline": pipeline}}


def _at(values: Any, *names: str) -> dict[str, Any]:
    """The object within objects that these names lead to; empty where there is none."""
    for name in names:
        values = values.get(name) if isinstance(values, Mapping) else None
    return dict(values) if isinstance(values, Mapping) else {}


_STEPS: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {7: _with_first_smallest_weight}
