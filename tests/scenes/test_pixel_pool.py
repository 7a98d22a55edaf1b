import pytest
import torch

from unmix_plugin.scenes.pixel_pool import PixelPool

PIXELS = 1000


SMALL = {"chunk_bytes": 160, "pixels_per_step": 20}
"""Chunks of 40 pixels of 4 bytes, each of two steps."""


def make_pool(valid=None, num_bytes=4000, reads=None) -> PixelPool:
    values = torch.arange(PIXELS, dtype=torch.int32)[:, None]

    def read(first: int, last: int) -> torch.Tensor:
        if reads is not None:
            reads.append((first, last))
        return values[first:last]

    return PixelPool(
        torch.ones(PIXELS, dtype=torch.bool) if valid is None else valid, 4, num_bytes, read, **SMALL
    )


def draw(pool: PixelPool, step: int, count: int = 20) -> torch.Tensor:
    pixels, values = pool.draw(count, step, torch.Generator().manual_seed(step))
    assert torch.equal(values[:, 0].long(), pixels)
    return pixels


def test_a_draw_is_the_same_whatever_was_drawn_before():
    going_on, resumed = make_pool(), make_pool()
    drawn = [draw(going_on, step) for step in range(120)]
    for step in (77, 78, 119, 3):
        assert torch.equal(draw(resumed, step), drawn[step])


def test_every_valid_pixel_comes_up_equally_often():
    valid = torch.ones(PIXELS, dtype=torch.bool)
    valid[100:250], valid[990:] = False, False
    pool, counts = make_pool(valid), torch.zeros(PIXELS)
    steps = 2 * 23 * 20  # whole turns of all chunks that have valid pixels
    for step in range(steps):
        counts += torch.bincount(draw(pool, step, 200), minlength=PIXELS)
    assert counts[~valid].sum() == 0
    expected = 200 * steps / int(valid.sum())
    assert float((counts[valid] / expected - 1).abs().max()) < 0.5
    halves = counts[valid].view(-1, 84).sum(dim=1) / (84 * expected)
    assert float((halves - 1).abs().max()) < 0.1


def test_chunks_are_read_whole_and_once_a_turn_as_they_come_into_the_pool():
    reads: list[tuple[int, int]] = []
    pool = make_pool(reads=reads)
    for step in range(40):
        draw(pool, step)
    # Five chunks are held, one comes every two steps, and four are read ahead.
    assert 5 + 19 <= len(reads) <= 5 + 19 + 4
    assert all(last - first == 40 for first, last in reads)
    assert pool.num_bytes == 800


@pytest.mark.parametrize("num_bytes", [4000, 8800])
def test_all_that_a_pool_holds_fits_into_its_memory(num_bytes):
    valid = torch.ones(PIXELS, dtype=torch.bool)
    pool = make_pool(valid, num_bytes)
    draw(pool, 0)
    held = [x for x in vars(pool).values() if isinstance(x, torch.Tensor) and x is not valid]
    assert num_bytes - 800 < sum(value.numel() * value.element_size() for value in held) <= num_bytes


def test_a_pool_as_large_as_the_block_reads_it_once_a_turn():
    pool = make_pool(num_bytes=10**6)
    assert pool.num_bytes == 4 * PIXELS
    assert len(draw(pool, 0, 20_000).unique()) == PIXELS


def test_an_error_of_the_disk_is_said_where_pixels_are_drawn():
    def fail(first: int, last: int) -> torch.Tensor:
        raise OSError(f"the disk is gone: {first} to {last}")

    pool = PixelPool(torch.ones(PIXELS, dtype=torch.bool), 4, 4000, fail, **SMALL)
    with pytest.raises(OSError, match="the disk is gone"):
        draw(pool, 0)
