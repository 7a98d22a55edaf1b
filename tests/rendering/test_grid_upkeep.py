"""Which cells count as occupied, by how much light they stop."""

import math
from dataclasses import replace

import pytest
import torch

from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.operators.occupancy import skip_distances
from unmix_plugin.rendering.grid_upkeep import _occupied_density
from unmix_plugin.rendering.renderer import VolumeRenderer

CELLS = 10
SHORT_WAY = 0.15
"""Across a cell of the box below, model units."""
RENDERER = VolumeRenderer(
    SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 0.5]])),
    skip_distances(torch.ones(CELLS, CELLS, CELLS) > 0),
    torch.ones(CELLS, CELLS, CELLS, dtype=torch.bool),
    step=0.2,
    smallest_weight=0.0,
)


def test_a_cell_as_wide_as_a_sample_is_occupied_from_an_opacity_of_3_percent():
    assert 1 - math.exp(-_occupied_density(RENDERER, CELLS) * RENDERER.step) == pytest.approx(0.03)


def test_a_cell_of_many_samples_is_occupied_from_an_opacity_of_8_percent_across_it_the_short_way():
    for step in (0.05, 0.02, 0.001):
        density = _occupied_density(replace(RENDERER, step=step), CELLS)
        assert 1 - math.exp(-density * SHORT_WAY) == pytest.approx(0.08)


def test_cells_of_an_unbounded_world_are_twice_as_wide():
    density = _occupied_density(replace(RENDERER, step=0.001, is_unbounded=True), CELLS)
    assert 1 - math.exp(-density * 0.4) == pytest.approx(0.08)
