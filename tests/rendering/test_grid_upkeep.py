"""Which cells count as occupied, by how much light they stop."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from unmix_plugin.engine.geometry.space import RayBundle, SceneBox
from unmix_plugin.engine.processes import ALONE
from unmix_plugin.operators.occupancy import OccupancyGrid, skip_distances
from unmix_plugin.rendering.grid_upkeep import occupied_density, record_seen, reopen_lost, shrinking
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
    assert 1 - math.exp(-occupied_density(RENDERER, CELLS) * RENDERER.step) == pytest.approx(0.03)


def test_a_cell_of_many_samples_is_occupied_from_an_opacity_of_8_percent_across_it_the_short_way():
    for step in (0.05, 0.02, 0.001):
        density = occupied_density(replace(RENDERER, step=step), CELLS)
        assert 1 - math.exp(-density * SHORT_WAY) == pytest.approx(0.08)


def test_cells_of_an_unbounded_world_are_twice_as_wide():
    density = occupied_density(replace(RENDERER, step=0.001, is_unbounded=True), CELLS)
    assert 1 - math.exp(-density * 0.4) == pytest.approx(0.08)


def seen_layers(weights: list[float], shrunk: float | None, visible_weight: float = 0.4) -> list[int]:
    """Layers of a grid that a ray through their middles saw, with these weights one after the other."""
    grid = OccupancyGrid(torch.ones(CELLS, CELLS, CELLS, dtype=torch.bool), one_view=True)
    depths = (torch.arange(len(weights)) + 0.5) / CELLS
    positions = torch.stack([torch.full_like(depths, 0.5), torch.full_like(depths, 0.5), depths], dim=-1)
    rays = torch.zeros(len(weights), dtype=torch.int64)
    rendered: Any = SimpleNamespace(ray_indices=rays, weights=torch.tensor(weights), positions=positions)
    record_seen(grid, rendered, torch.tensor([3]), visible_weight, ALONE, shrunk)
    return sorted({int(layer) for layer in (grid.visibility.lowest_view == 3).nonzero()[:, 2]})


def test_haze_shrinks_to_the_heaviest_sample_however_light_it_is():
    haze = [0.01, 0.02, 0.03, 0.05, 0.04, 0.01]
    assert seen_layers(haze, shrunk=1.0) == [2, 3, 4]
    assert seen_layers(haze, shrunk=1.0, visible_weight=0.9) == [3]
    assert seen_layers([x / 100 for x in haze], shrunk=1.0) == [2, 3, 4]
    assert seen_layers(haze, shrunk=None, visible_weight=0.1) == []


def test_haze_shrinks_little_by_little_once_rays_found_where_they_end():
    haze = [0.01, 0.02, 0.03, 0.05, 0.04, 0.01]
    assert seen_layers(haze, shrunk=0.0) == []
    assert seen_layers(haze, shrunk=0.6) == [1, 2, 3, 4]
    assert [shrinking(progress) for progress in (0.0, 0.05, 0.3, 1.0)] == [0.0, 0.0, 1.0, 1.0]
    assert shrinking(0.1) < shrinking(0.2)


def test_a_ray_that_lost_what_it_ended_on_gets_its_cells_back_and_others_do_not():
    grid = OccupancyGrid(torch.ones(CELLS, CELLS, CELLS, dtype=torch.bool), one_view=True)
    grid.visibility.visible.zero_()
    box = SceneBox(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    origins = torch.tensor([[-0.9, -0.9, 3.0], [0.9, 0.9, 3.0]])
    rays = RayBundle(origins, torch.tensor([[0.0, 0.0, -1.0]] * 2), torch.tensor([3, 3]))
    rendered: Any = SimpleNamespace(coefficients=SimpleNamespace(accumulation=torch.tensor([0.3, 0.99])))
    reopen_lost(grid, rendered, rays, box)
    seen = torch.zeros(1, dtype=torch.int64)
    grid.visibility.record(torch.full((1, 3), 0.45), seen, seen == 0, 100_000)
    grid.visibility.update()
    assert grid.visibility.visible[0, 0].all()
    assert not grid.visibility.visible[-1, -1].any()
