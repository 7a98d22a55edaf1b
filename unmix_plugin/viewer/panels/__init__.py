"""The controls: one file a panel."""

from __future__ import annotations

from collections.abc import Callable

from unmix_plugin.viewer.panels.capture import CapturePanel
from unmix_plugin.viewer.panels.materials import MaterialsPanel
from unmix_plugin.viewer.panels.measure import MeasurePanel
from unmix_plugin.viewer.panels.probe import ProbePanel, ValuesPanel
from unmix_plugin.viewer.panels.regions import RegionsPanel
from unmix_plugin.viewer.panels.training import TrainingPanel
from unmix_plugin.viewer.panels.view import LayerPanel, LightPanel, ScenePanel
from unmix_plugin.viewer.session import Services, Session


def panels_of(services: Services) -> list[tuple[str, Callable[[Session], object]]]:
    """Titles and builders of the panels of a viewer, in the order of their tabs."""
    panels: list[tuple[str, Callable[[Session], object], bool]] = [
        ("view", LayerPanel, True),
        ("light", LightPanel, bool(services.lights)),
        ("scene", ScenePanel, True),
        ("probe", ProbePanel if services.has_materials else ValuesPanel, True),
        ("measure", MeasurePanel, True),
        ("regions", RegionsPanel, services.has_materials),
        ("materials", MaterialsPanel, services.has_materials),
        ("capture", CapturePanel, True),
        ("training", TrainingPanel, services.source.control is not None),
    ]
    return [(title, build) for title, build, applies in panels if applies]
