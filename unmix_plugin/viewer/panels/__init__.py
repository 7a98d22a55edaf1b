"""The controls: one file a panel, listed here in the order of their tabs."""

from __future__ import annotations

from unmix_plugin.viewer.panels.capture import CapturePanel
from unmix_plugin.viewer.panels.materials import MaterialsPanel
from unmix_plugin.viewer.panels.probe import ProbePanel, ValuesPanel
from unmix_plugin.viewer.panels.training import TrainingPanel
from unmix_plugin.viewer.panels.view import LayerPanel, LightPanel, ScenePanel
from unmix_plugin.viewer.session import Panel

PANELS = (
    Panel("view", LayerPanel),
    Panel("light", LightPanel, lambda services: bool(services.lights)),
    Panel("scene", ScenePanel),
    Panel("probe", ProbePanel, lambda services: services.has_materials),
    Panel("probe", ValuesPanel, lambda services: not services.has_materials),
    Panel("materials", MaterialsPanel, lambda services: services.has_materials),
    Panel("capture", CapturePanel),
    Panel("training", TrainingPanel, lambda services: services.source.control is not None),
)
"""Every panel."""
