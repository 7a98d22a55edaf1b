"""The controls: one file a panel, listed here in the order of their tabs."""

from __future__ import annotations

from unmix_plugin.viewer.panels.capture_panel import CapturePanel
from unmix_plugin.viewer.panels.layer_panel import LayerPanel
from unmix_plugin.viewer.panels.light_panel import LightPanel
from unmix_plugin.viewer.panels.materials_panel import MaterialsPanel
from unmix_plugin.viewer.panels.probe_panel import ProbePanel
from unmix_plugin.viewer.panels.scene_panel import ScenePanel
from unmix_plugin.viewer.panels.training_panel import TrainingPanel, is_training
from unmix_plugin.viewer.panels.values_panel import ValuesPanel
from unmix_plugin.viewer.services import Services
from unmix_plugin.viewer.session import Panel


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
