import numpy as np

from unmix_plugin.figures.pictures import Canvas, CanvasLayout

NAMES = ["endmember_0", "endmember_1", "endmember_10"]


def test_small_tiles_have_room_for_their_names():
    """The strips of names that differ in their last letter differ, however narrow the tiles are."""
    layout = CanvasLayout.of((16, 8), NAMES)
    canvas = Canvas(layout, 3, NAMES, [(0.5, 0.5, 0.5)] * 3)
    lefts = [layout.corner(index)[1] for index in range(3)]
    strips = [canvas.pixels[: layout.above_px, left : left + layout.column_px] for left in lefts]
    assert not np.array_equal(strips[0], strips[1])
    assert not np.array_equal(strips[1], strips[2])
    assert all((strip[:, -2:] == 255).all() for strip in strips)


def test_a_tile_stands_under_its_name():
    layout = CanvasLayout.of((16, 8), NAMES)
    canvas = Canvas(layout, 3, NAMES)
    tiles = np.zeros((8, 16, 3, 3), np.uint8)
    tiles[:, :, 1] = 100
    canvas.put(0, tiles)
    top, left = layout.corner(1)
    assert (canvas.pixels[top : top + 8, left : left + 16] == 100).all()
    assert (canvas.pixels[layout.above_px :] == 100).all(axis=-1).sum() == 8 * 16


def test_very_long_names_are_shortened_rather_than_widening_everything():
    layout = CanvasLayout.of((16, 8), ["x" * 500])
    assert layout.column_px == 240
    assert (Canvas(layout, 3, ["x" * 500]).pixels[:18, -2:] == 255).all()
    assert CanvasLayout.of((16, 8), ["450 nm", "1000 nm"], count=1).size[0] >= 40
