"""How fine to render: soon while moving, in steps up to what was asked, in blocks of about the same time."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.viewer.rendering.pictures import (
    BLOCK_S,
    FEWEST_PIXELS,
    LONGEST_MOVING_S,
    Speedometer,
    affordable_height,
    finer_height,
    moving_height,
)

speeds = st.floats(1e3, 1e8)


@given(speeds, st.floats(0.2, 5), st.integers(16, 2048))
def test_a_moving_picture_takes_no_longer_than_its_time(speed, aspect, largest):
    height = moving_height(speed, aspect, largest)
    assert 1 <= height <= largest
    pixels = height * height * aspect
    assert pixels <= max(speed * LONGEST_MOVING_S, FEWEST_PIXELS) * 1.01


def test_a_fast_device_shows_moving_pictures_in_full_size():
    assert moving_height(3e7, 1.0, 512) == 512


@given(st.integers(1, 512), st.integers(16, 2048))
def test_pictures_become_finer_until_the_finest_and_then_no_more(start, largest):
    heights = [min(start, largest)]
    while (finer := finer_height(heights[-1], largest)) is not None:
        assert finer > heights[-1]
        heights.append(finer)
    assert heights[-1] == largest
    assert len(heights) <= 13


@given(speeds, st.floats(0.1, 5), st.floats(0.2, 5))
def test_what_is_affordable_takes_about_the_time_given(speed, seconds, aspect):
    height = affordable_height(speed, seconds, aspect, 10**6)
    assert height * height * aspect <= max(speed * seconds, aspect) * 1.001


def test_a_speedometer_follows_what_is_measured():
    speed = Speedometer()
    for _ in range(30):
        speed.add(1000, 0.01)
    assert speed.rays_per_second == pytest.approx(1e5, rel=0.01)
    assert speed.block_rays == pytest.approx(1e5 * BLOCK_S, rel=0.01)


def test_measurements_that_say_nothing_change_nothing():
    speed = Speedometer()
    before = speed.rays_per_second
    speed.add(0, 1.0)
    speed.add(100, 0.0)
    assert speed.rays_per_second == before


def test_blocks_have_bounds_whatever_is_measured():
    assert Speedometer(1.0).block_rays == 256
    assert Speedometer(1e12).block_rays == 1 << 17
