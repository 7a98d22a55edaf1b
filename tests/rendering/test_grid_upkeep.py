import math
from dataclasses import replace

import pytest
import torch

from unmix_plugin.engine.geometry.space import SceneBox, UnitSpace
from unmix_plugin.operators.occupancy import skip_distances
from unmix_plugin.rendering.grid_upkeep import occupied_density
from unmix_plugin.rendering.renderer import VolumeRenderer

CELLS = 10
SHORT_WAY = 0.15
"""Across a cell of the box below, model units."""
RENDERER = VolumeRenderer(
    UnitSpace(SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 0.5]]))),
    skip_distances(torch.ones(CELLS, CELLS, CELLS) > 0),
    step=0.2,
    smallest_weight=0.0,
)

WORLD = UnitSpace(RENDERER.box, is_unbounded=True)


@pytest.mark.parametrize(
    ("changes", "way", "opacity"),
    [
        ({}, RENDERER.step, 0.03),  # as wide as a sample
        *(({"step": step}, SHORT_WAY, 0.08) for step in (0.05, 0.02, 0.001)),  # many samples across it
        (
            {"step": 0.001, "space": WORLD},
            0.4,
            0.08,
        ),  # cells of a world are twice as wide
    ],
)
def test_a_cell_is_occupied_from_an_opacity_along_a_sample_or_across_it_the_short_way(changes, way, opacity):
    density = occupied_density(replace(RENDERER, **changes), CELLS)
    assert 1 - math.exp(-density * way) == pytest.approx(opacity)
