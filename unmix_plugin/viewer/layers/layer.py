"""One thing that can be shown of a rendered view."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.layers.layer_settings import LayerSettings
from unmix_plugin.viewer.layers.painting import Legend, Picture

Painter = Callable[[Any, LayerSettings, Any], tuple[Picture, Legend]]
"""From a rendered view, of the kind of scene that has the layer, and what layers need of the run."""


@dataclass(frozen=True)
class Layer:
    """A name, what users read, and the function that paints it."""

    name: str
    """As in outputs of renders, where there is such an output."""
    title: str
    """What users read."""
    paint: Painter
    controls: frozenset[str]
    """Which of `wavelength`, `false-colour`, `endmember`, `index`, `tone`, `scale` apply."""
    is_labels: bool = False
    """Whether each colour stands for something of its own, so that pictures must not be compressed with loss."""


def layer_named(name: str, layers: Mapping[str, Layer]) -> Layer:
    """A layer by its name.

    Raises:
        ConfigError: there is none.
    """
    if name not in layers:
        raise ConfigError(f"there is no layer named {name[:40]!r}; known: {', '.join(layers)}")
    return layers[name]
