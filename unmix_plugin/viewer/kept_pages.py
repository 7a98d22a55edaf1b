"""What pages leave behind, so that a page that is loaded again goes on where it was."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from unmix_plugin.trained.relighting import LightChoice
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.recipe_editor import RecipeHistory
from unmix_plugin.viewer.view_cameras import ViewPose

if TYPE_CHECKING:
    import viser

KEPT_S = 600.0
"""How long what a page left is kept."""

_MOST_KEPT = 64
_KEY = "unmix-nerf"
_ANSWER_S = 2.0


@dataclass(frozen=True)
class PageState:
    """What a page shows, and the edits that it may go back to."""

    pose: ViewPose | None
    settings: LayerSettings
    history: RecipeHistory
    largest_height: int
    subpixels: int
    light: LightChoice = LightChoice()


class KeptPages:
    """States of pages that were closed recently, by the browser that they were in."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left: list[tuple[float, str, PageState]] = []
        self._lock = threading.Lock()

    def leave(self, browser: str, state: PageState) -> None:
        """Keep the state of a page that was closed."""
        with self._lock:
            self._left = [*self._left, (self._clock(), browser, state)][-_MOST_KEPT:]

    def take(self, browser: str) -> PageState | None:
        """The state of the browser's page that was closed last and has not come back; None if there is none."""
        with self._lock:
            self._left = [kept for kept in self._left if self._clock() - kept[0] < KEPT_S]
            for index in range(len(self._left) - 1, -1, -1):
                if self._left[index][1] == browser:
                    return self._left.pop(index)[2]
        return None


def browser_of(client: viser.ClientHandle) -> str:
    """The name that a page's browser keeps for this viewer, a new one if it has none or does not say."""
    try:
        known = client.local_storage.get_item(_KEY, _ANSWER_S)
    except (RuntimeError, TimeoutError):  # storage is blocked, or the page has gone
        known = None
    if isinstance(known, str) and 0 < len(known) < 100:
        return known
    name = secrets.token_hex(16)
    client.local_storage.set_item(_KEY, name)
    return name
