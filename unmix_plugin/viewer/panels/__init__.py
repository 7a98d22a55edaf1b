"""The controls: one file a panel, listed here in the order of their tabs."""

from __future__ import annotations

from unmix_plugin.viewer.panels.capture import CapturePanel
from unmix_plugin.viewer.panels.materials import MaterialsPanel
from unmix_plugin.viewer.panels.probe import ProbePanel, ValuesPanel
from unmix_plugin.viewer.panels.training import TrainingPanel, is_training
from unmix_plugin.viewer.panels.view import LayerPanel, LightPanel, ScenePanel
from unmix_plugin.viewer.session import Panel, Services


def has_materials(services: Services) -> bool:
    """Whether the scene unmixes spectra."""
    return services.has_materials


PANELS = (
    Panel("view", LayerPanel),
    Panel("light", LightPanel, lambda services: bool(services.lights)),
    Panel("scene", ScenePanel),
    Panel("probe", ProbePanel, has_materials),
    Panel("probe", ValuesPanel, lambda services: not has_materials(services)),
    Panel("materials", MaterialsPanel, has_materials),
    Panel("capture", CapturePanel),
    Panel("training", TrainingPanel, is_training),
)
"""Every panel."""

__all__ = ["PANELS", "Panel"]
