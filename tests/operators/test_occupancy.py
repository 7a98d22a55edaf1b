"""The occupancy grid: which cells are occupied, visible and near one another."""

import pytest
import torch
from scipy.ndimage import distance_transform_cdt

from unmix_plugin.operators.occupancy import OccupancyGrid, VisibleCells, skip_distances


def ball(points: torch.Tensor) -> torch.Tensor:
    return 100.0 * ((points - 0.5).norm(dim=-1) < 0.25)


def updated(grid, density_fn, times=1, num_cells=None, seed=0, block=1):
    threshold, decay, generator = 1.0, 0.5, torch.Generator().manual_seed(seed)
    for _ in range(times):
        grid.update(density_fn, threshold, decay, num_cells, generator, block)
    return grid


def nothing(points):
    return torch.zeros(len(points))


def full(side: int = 8) -> OccupancyGrid:
    return OccupancyGrid(torch.ones(side, side, side, dtype=torch.bool))


def test_cells_are_occupied_where_there_is_density_and_empty_elsewhere():
    grid = updated(full(), ball, times=10)
    few = updated(full(), ball, times=60, num_cells=128)
    assert (few.occupied != grid.occupied).float().mean() < 0.05
    centres = (torch.stack(torch.meshgrid(*[torch.arange(8)] * 3, indexing="ij"), -1) + 0.5) / 8
    distance = (centres - 0.5).norm(dim=-1)
    assert grid.occupied[distance < 0.2].all()
    assert not grid.occupied[distance > 0.4].any()


def test_what_is_emptied_later_stays_empty_and_all_else_is_as_it_was():
    reachable = torch.ones(8, 8, 8, dtype=torch.bool)
    reachable[:4] = False
    grid, other = updated(full(), ball, times=3), updated(full(), ball, times=3)
    grid.empty_beyond(reachable)
    assert torch.equal(grid.occupied[4:], other.occupied[4:])
    assert not grid.occupied[:4].any()
    assert torch.equal(grid.skips, skip_distances(grid.occupied != 0))
    updated(grid, ball, times=3, seed=1)
    assert not grid.occupied[:4].any()
    assert grid.occupied[4:].any()


def test_a_cell_is_forgotten_once_its_density_has_decayed_and_occupied_again_when_it_gains_some():
    grid = updated(full(4), lambda points: torch.full((len(points),), 8.0))
    assert grid.occupied.all()
    updated(grid, nothing, times=2)
    assert grid.occupied.all()
    updated(grid, nothing, times=2)
    assert not grid.occupied.any()
    updated(grid, ball, times=4)
    assert grid.occupied[1:3, 1:3, 1:3].all()


def test_a_thin_density_everywhere_stays_visible():
    """The threshold never exceeds the mean, so a faint scene isn't taken for empty space."""
    grid = updated(full(4), lambda points: 0.01 + 0.01 * points[:, 0], times=3)
    assert 0 < grid.occupied.float().mean() < 1


def test_a_grid_that_was_loaded_goes_on_like_the_one_that_was_saved():
    reachable = torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(0)) < 0.5
    saved = updated(OccupancyGrid(reachable), ball, times=3, num_cells=40)
    loaded = full(6)
    loaded.load_state_dict(saved.state_dict())
    for grid in (saved, loaded):
        updated(grid, ball, times=5, num_cells=40, seed=1)
    assert torch.equal(loaded.peak_densities, saved.peak_densities)
    assert torch.equal(loaded.occupied, saved.occupied)
    assert not loaded.occupied[~reachable].any()


def observed_by_rays(grid: OccupancyGrid, density_fn, num_points: int, generator: torch.Generator) -> None:
    points = torch.rand(num_points, 3, generator=generator)
    grid.record_observed(points, density_fn(points))


def test_cells_in_which_rays_met_nothing_are_empty_without_being_probed():
    generator = torch.Generator().manual_seed(3)
    known, unknown = OccupancyGrid(torch.ones(8, 8, 8) > 0, records_observed=True), full()
    for _ in range(8):
        for grid in (known, unknown):
            observed_by_rays(grid, ball, 4000, generator)
            updated(grid, ball, num_cells=2)
    reference = updated(full(), ball, times=10)
    assert unknown.occupied.float().mean() > 0.9
    assert (known.occupied != reference.occupied).float().mean() < 0.05


def test_what_rays_met_counts_once_and_the_largest_in_a_cell():
    grid = OccupancyGrid(torch.ones(2, 2, 2) > 0, records_observed=True)
    updated(grid, nothing)
    points = torch.tensor([[0.1, 0.1, 0.1], [0.2, 0.3, 0.1], [0.9, 0.9, 0.9]])
    grid.record_observed(points, torch.tensor([3.0, 8.0, 0.5]))
    updated(grid, nothing, num_cells=0)
    assert float(grid.peak_densities[0, 0, 0]) == 8.0
    assert float(grid.peak_densities[1, 1, 1]) == 0.5
    updated(grid, nothing, num_cells=0)
    assert float(grid.peak_densities[0, 0, 0]) == 8.0


def test_cells_of_a_block_stay_while_one_of_them_is_dense():
    """Small cells are soon emptied by chance; blocks of them only where nothing was met in any."""
    for block, expected in ((1, 1), (2, 8), (3, 27)):
        grid = OccupancyGrid(torch.ones(5, 5, 5) > 0, records_observed=True)
        updated(grid, nothing)
        grid.record_observed(torch.tensor([[0.5, 0.5, 0.5]]), torch.tensor([8.0]))
        updated(grid, nothing, num_cells=0, block=block)
        assert int(grid.occupied.sum()) == expected


SIDE = 8
ENOUGH_RAYS = 16 * SIDE * SIDE


def record(cells: VisibleCells, *sights, seen: bool = True, num_rays: int = ENOUGH_RAYS) -> None:
    """Samples in the middle of cells, each with the number of its view."""
    points = (torch.tensor([cell for cell, _ in sights]) + 0.5) / SIDE
    views = torch.tensor([view for _, view in sights])
    cells.record(points, views, torch.full((len(sights),), seen), num_rays)


NEAR, FAR = (1, 1, 1), (6, 6, 6)


@pytest.mark.parametrize(
    ("sights", "unseen", "opened", "closed"),
    [
        ([(NEAR, 3), (NEAR, 5), (FAR, 3), (FAR, 3)], [], [NEAR, (0, 2, 1)], [FAR, (3, 1, 1)]),
        ([(NEAR, 0), (FAR, 0)], [], [NEAR, FAR], [(3, 3, 3)]),  # a single view
        ([(NEAR, 0), (NEAR, 1)], [(FAR, 0), (FAR, 1)], [NEAR], [FAR]),  # samples that send too little light
        ([], [(FAR, 0), (FAR, 1)], [NEAR, FAR], []),  # where none sends enough, all stays
    ],
)
def test_what_two_views_see_stays_with_its_neighbours_and_the_rest_is_closed(sights, unseen, opened, closed):
    cells = VisibleCells((SIDE, SIDE, SIDE))
    for some, seen in ((sights, True), (unseen, False)):
        if some:
            record(cells, *some, seen=seen)
    cells.update()
    assert all(cells.visible[cell] for cell in opened)
    assert not any(cells.visible[cell] for cell in closed)


@pytest.mark.parametrize("more", [0, 1])
def test_nothing_is_left_out_before_enough_rays_were_cast(more):
    """Of which large pictures need more, and views may have large numbers."""
    cells = VisibleCells((SIDE, SIDE, SIDE))
    record(cells, (NEAR, 1000), (NEAR, 1001), num_rays=ENOUGH_RAYS - 1 + more)
    cells.update(fewest_rays=ENOUGH_RAYS + more)
    assert cells.visible.all()
    record(cells, (FAR, 1000), (FAR, 1001), num_rays=1)
    cells.update(fewest_rays=ENOUGH_RAYS + more)
    assert [bool(cells.visible[cell]) for cell in (NEAR, FAR, (4, 1, 1))] == [True, True, False]


def test_only_what_was_seen_since_the_last_update_counts_and_the_open_cells_follow_a_surface():
    cells = VisibleCells((SIDE, SIDE, SIDE))
    for x in (3, 4):
        record(cells, ((x, 3, 3), 0), ((x, 3, 3), 1))
        cells.update()
    expected = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    expected[3:6, 2:5, 2:5] = True
    assert torch.equal(cells.visible, expected)


def test_points_on_the_faces_of_the_box_belong_to_the_outermost_cells():
    cells = VisibleCells((SIDE, SIDE, SIDE))
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]).repeat(2, 1)
    cells.record(corners, torch.tensor([0, 0, 1, 1]), torch.ones(4, dtype=torch.bool), ENOUGH_RAYS)
    cells.update()
    assert cells.visible[0, 0, 0]
    assert cells.visible[-1, -1, -1]
    assert int(cells.visible.sum()) == 16


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 5, 7), (40, 9, 20), (50, 50, 50)])
def test_clearance_is_the_distance_along_the_farthest_axis_rounded_down(shape):
    occupied = torch.rand(shape, generator=torch.Generator().manual_seed(0)) < 1e-3
    occupied[shape[0] // 3, -1, 0] = True
    distance = torch.from_numpy(distance_transform_cdt(~occupied.numpy(), metric="chessboard"))
    steps = torch.tensor([0, 1, 2, 3, 5, 9, 17])
    expected = steps[torch.bucketize(distance, steps, right=True) - 1]
    assert torch.equal(skip_distances(occupied).long(), expected)
    assert (skip_distances(torch.zeros(shape, dtype=torch.bool)) == 17).all()  # as far as is counted
