"""What one client looks at, and how far its picture has come. Changed only under the render loop's lock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, UInt8

from unmix_plugin.trained.protocol import RenderedView
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.layers.painting import Legend
from unmix_plugin.viewer.rendering.edits import Edit
from unmix_plugin.viewer.rendering.frames import FrameRender
from unmix_plugin.viewer.view_cameras import ViewPose

HEIGHT_BOUNDS = (16, 2048)
DEFAULT_HEIGHT = 512
SUBPIXEL_BOUNDS = (1, 4)


@dataclass(frozen=True)
class Shown:
    """A picture for one client."""

    picture: UInt8[np.ndarray, "H W 3"]
    """sRGB."""
    depth: Float32[np.ndarray, "rows columns"] | None
    """Along the viewing axis, scene units, far where nothing is, perhaps in fewer pixels; None where the client needs
    none."""
    legend: Legend
    is_moving: bool
    """Whether a finer picture follows at once."""
    is_labels: bool = False
    """Whether its colours are exact."""


@dataclass(eq=False)
class View:
    """One client's view; compared by identity."""

    show: Callable[[Shown], None]
    """Sends a picture."""
    report: Callable[[str], None]
    """Says what went wrong; an empty text that all is well again."""
    settings: LayerSettings = LayerSettings()
    edit: Edit = Edit()
    largest_height: int = DEFAULT_HEIGHT
    """Rows of the finest picture."""
    subpixels: int = 1
    """Rays through a pixel of the finest picture, along each of its edges."""
    wants_depth: bool = False
    """Whether objects of the client's own are to be hidden behind what is seen."""
    pose: ViewPose | None = None
    frame: RenderedView | None = None
    """The picture shown last."""
    frame_edit: Edit = Edit()
    """What `frame` was rendered with."""
    frame_version: int = -1
    """The model's version that `frame` shows."""
    moved_at: float | None = None
    """When the first camera movement without a picture yet came; None if there is none."""
    restyled_at: float | None = None
    """The same for changes that need no rendering."""
    render: FrameRender | None = None
    """The finer picture under way."""
    render_version: int = -1
    served_at: float = 0.0
    """When a block was last rendered for it."""
    shown_at: float = 0.0
    is_stuck: bool = False
    """Whether its last picture failed; it is tried again once something changes."""
    has_reported: bool = False
    """Whether its client was told of a failure."""

    @property
    def asked_at(self) -> float | None:
        """Since when it waits for a picture at once."""
        return self.restyled_at if self.moved_at is None else self.moved_at


@dataclass(eq=False)
class Capture:
    """A picture to be rendered apart from any view, of any size, when there is nothing more urgent."""

    render: FrameRender
    edit: Edit
    done: Callable[[RenderedView | None, str], None]
    """Takes the frame, or None and what went wrong; called in the render loop's thread."""
    progress: Callable[[float], None] = field(default=lambda _: None)
    """Takes the fraction rendered so far, now and then."""
    served_at: float = 0.0
    is_cancelled: bool = False
