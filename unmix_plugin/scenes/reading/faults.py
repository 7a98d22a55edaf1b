"""Collect every fault of a scene, so that a user mends them in one go and not one a start."""

from __future__ import annotations

from pathlib import Path

from unmix_plugin.errors import SceneError

MAX_LISTED = 20
"""Faults written out in one message; the rest is counted."""
MAX_PLACES = 3
"""Places written out for a fault that many frames share."""


class Faults:
    """What is wrong with one scene, in the order found; the same fault in many places is reported once."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._places: dict[str, list[str]] = {}
        self._noted = 0

    def add(self, where: str, message: str) -> None:
        """Note a fault.

        Args:
            where: File, frame or key that has it.
            message: What was found against what was expected, and what to do.
        """
        self._noted += 1
        places = self._places.setdefault(message, [])
        if where not in places:
            places.append(where)

    @property
    def noted(self) -> int:
        """How often a fault was noted so far, repetitions included."""
        return self._noted

    def raise_if_any(self) -> None:
        """End here if anything is wrong.

        Raises:
            SceneError: one or more faults were noted; its message lists them.
        """
        if not self._places:
            return
        lines = [
            message if places == [str(self._root)] else f"{_name_places(places)}: {message}"
            for message, places in self._places.items()
        ]
        if len(lines) == 1:
            raise SceneError(f"{self._root}: {lines[0]}")
        listed = [f"  {number}. {line}" for number, line in enumerate(lines[:MAX_LISTED], start=1)]
        if len(lines) > MAX_LISTED:
            listed.append(f"  and {len(lines) - MAX_LISTED} more")
        raise SceneError("\n".join([f"{self._root}: {len(lines)} faults in the scene", *listed]))


def _name_places(places: list[str]) -> str:
    shown = ", ".join(places[:MAX_PLACES])
    hidden = len(places) - MAX_PLACES
    return f"{shown} and {hidden} more" if hidden > 0 else shown
