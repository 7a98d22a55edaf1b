"""Click a point of a scene without endmembers: the numbers of its outputs there."""

from __future__ import annotations

from typing import TYPE_CHECKING

from unmix_plugin.viewer import html
from unmix_plugin.viewer.inputs import number
from unmix_plugin.viewer.session import Session
from unmix_plugin.viewer.view_cameras import camera_of

if TYPE_CHECKING:
    import viser

_PROBED_ROWS = 512
_MOST_NUMBERS = 8


class ValuesPanel:
    """Shows what a scene is at the point that was clicked last."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._text = session.client.gui.add_html(html.paragraph("Click a point of the picture."))
        session.client.scene.on_click()(self._clicked)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        x, y = event.screen_pos
        self._session.guarded(lambda: self._take(x, y))()

    def _take(self, x: float, y: float) -> None:
        """Probe a point of the canvas, given in parts of its width and height."""
        camera = camera_of(self._session.pose(), _PROBED_ROWS)
        column = min(int(number(x, 0.0, 1.0, fallback=0.5) * camera.width), camera.width - 1)
        row = min(int(number(y, 0.0, 1.0, fallback=0.5) * camera.height), camera.height - 1)
        with self._session.services.source.borrowed() as scene:
            found = scene.probe(camera, column, row)
        rows = [
            (name, ", ".join(f"{value:.4g}" for value in values[:_MOST_NUMBERS]))
            for name, values in found.values.items()
        ]
        if found.world_position is not None:
            rows.append(("position", ", ".join(f"{value:.3f}" for value in found.world_position)))
        self._text.content = html.table(rows)
