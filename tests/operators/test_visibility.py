"""Which cells stay visible after rays were cast."""

import torch

from unmix_plugin.operators.visibility import VisibleCells

SIDE = 8
ENOUGH_RAYS = 16 * SIDE * SIDE


def looked_at(
    *sights: tuple[tuple[int, int, int], int], seen: bool = True, num_rays=ENOUGH_RAYS
) -> VisibleCells:
    """Cells after samples in the middle of these ones, each with the number of its view, and a judgement."""
    cells = VisibleCells((SIDE, SIDE, SIDE))
    record(cells, *sights, seen=seen, num_rays=num_rays)
    cells.update()
    return cells


def record(cells: VisibleCells, *sights, seen: bool = True, num_rays: int = ENOUGH_RAYS) -> None:
    points = (torch.tensor([cell for cell, _ in sights]) + 0.5) / SIDE
    views = torch.tensor([view for _, view in sights])
    cells.record(points, views, torch.full((len(sights),), seen), num_rays)


def test_what_two_views_see_stays_with_its_neighbours_and_the_rest_is_closed():
    cells = looked_at(((2, 3, 4), 0), ((2, 3, 4), 1))
    expected = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    expected[1:4, 2:5, 3:6] = True
    assert torch.equal(cells.visible, expected)


def test_what_one_view_sees_however_often_is_closed():
    cells = looked_at(((1, 1, 1), 3), ((1, 1, 1), 5), ((6, 6, 6), 3), ((6, 6, 6), 3))
    assert cells.visible[1, 1, 1]
    assert not cells.visible[6, 6, 6]


def test_of_a_single_view_all_that_it_sees_stays():
    cells = looked_at(((1, 1, 1), 0), ((6, 6, 6), 0))
    assert cells.visible[1, 1, 1]
    assert cells.visible[6, 6, 6]
    assert not cells.visible[3, 3, 3]


def test_samples_that_send_too_little_light_see_nothing():
    cells = VisibleCells((SIDE, SIDE, SIDE))
    record(cells, ((6, 6, 6), 0), ((6, 6, 6), 1), seen=False)
    record(cells, ((1, 1, 1), 0), ((1, 1, 1), 1))
    cells.update()
    assert cells.visible[1, 1, 1]
    assert not cells.visible[6, 6, 6]


def test_density_too_thin_for_any_sample_to_be_seen_stays():
    cells = looked_at(((6, 6, 6), 0), ((6, 6, 6), 1), seen=False)
    assert cells.visible.all()


def test_nothing_is_left_out_before_enough_rays_were_cast():
    cells = looked_at(((1, 1, 1), 0), ((1, 1, 1), 1), num_rays=ENOUGH_RAYS - 1)
    assert cells.visible.all()
    record(cells, ((6, 6, 6), 0), ((6, 6, 6), 1), num_rays=1)
    cells.update()
    assert cells.visible[1, 1, 1]
    assert cells.visible[6, 6, 6]
    assert not cells.visible[4, 1, 1]


def test_large_pictures_need_more_rays_before_anything_is_left_out():
    cells = VisibleCells((SIDE, SIDE, SIDE))
    record(cells, ((1, 1, 1), 0), ((1, 1, 1), 1))
    cells.update(fewest_rays=ENOUGH_RAYS + 1)
    assert cells.visible.all()
    record(cells, ((1, 1, 1), 2), num_rays=1)
    cells.update(fewest_rays=ENOUGH_RAYS + 1)
    assert not cells.visible[4, 1, 1]


def test_only_what_was_seen_since_the_last_update_counts_and_the_open_cells_follow_a_surface():
    cells = looked_at(((3, 3, 3), 0), ((3, 3, 3), 1))
    record(cells, ((4, 3, 3), 0), ((4, 3, 3), 1))
    cells.update()
    assert cells.visible[5, 3, 3]
    assert not cells.visible[2, 3, 3]


def test_views_of_large_numbers_are_told_apart():
    cells = looked_at(((2, 2, 2), 1000), ((2, 2, 2), 1001))
    assert cells.visible[2, 2, 2]
    assert not cells.visible[6, 6, 6]


def test_points_on_the_faces_of_the_box_belong_to_the_outermost_cells():
    cells = VisibleCells((SIDE, SIDE, SIDE))
    corners = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]).repeat(2, 1)
    cells.record(corners, torch.tensor([0, 0, 1, 1]), torch.ones(4, dtype=torch.bool), ENOUGH_RAYS)
    cells.update()
    assert cells.visible[0, 0, 0]
    assert cells.visible[-1, -1, -1]
    assert int(cells.visible.sum()) == 16
