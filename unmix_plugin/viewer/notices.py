"""Notices in a corner of a client's page."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import viser

_SHOWN_S = 8.0
_LONGEST = 2000
"""Characters of a notice."""


class Notices:
    """Notices to a client: warnings and notes on edits replace the ones before."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._warning: viser.NotificationHandle | None = None
        self._warning_said = (-math.inf, "")
        self._note: viser.NotificationHandle | None = None
        self._notes: tuple[str, ...] = ()

    def say(self, title: str, text: str) -> viser.NotificationHandle:
        """Show a notice."""
        return self._add(title, text, "teal")

    def warn(self, text: str, title: str) -> None:
        """Show a warning in place of the one before: a control that is dragged causes many. The same one is shown once
        in 8 s."""
        before, self._warning_said = self._warning_said, (time.monotonic(), text)
        if before[1] == text and self._warning_said[0] - before[0] < _SHOWN_S:
            return
        if self._warning is not None:
            self._warning.remove()
        self._warning = self._add(title, text, "red")

    def show_notes(self, notes: tuple[str, ...]) -> None:
        """Show what is new among the notes of the edit in force, in place of those shown before."""
        new = [note for note in notes if note not in self._notes]
        self._notes = notes
        if new:
            if self._note is not None:
                self._note.remove()
            self._note = self.say("edited", "; ".join(new))

    def _add(self, title: str, text: str, colour: Literal["teal", "red"]) -> viser.NotificationHandle:
        return self._client.add_notification(
            title, text[:_LONGEST], auto_close_seconds=_SHOWN_S, color=colour
        )
