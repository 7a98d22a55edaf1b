"""Surfaces of one object are laid on each other without markers; those of different ones are refused."""

from dataclasses import replace

import numpy as np
import pytest

from tests.factories.changed_objects import MOVED, PIXEL, in_world, lumpy, surface_of_shape
from unmix_plugin.comparing.registration import Similarity, light_between, register
from unmix_plugin.errors import ConfigError


def rms_px(found: Similarity, true: Similarity, positions: np.ndarray) -> float:
    """Between where points are laid and where they belong."""
    off = np.linalg.norm(found.apply(positions) - true.apply(positions), axis=1)
    return float(np.sqrt((off**2).mean())) / PIXEL


@pytest.fixture(scope="module")
def surface():
    return surface_of_shape()


def test_a_turned_moved_and_larger_world_is_found_to_a_fraction_of_a_pixel(surface):
    generator = np.random.default_rng(0)
    light = np.array([1.1, 1.2, 1.3, 1.25])
    rough = replace(
        surface_of_shape(subdivisions=4),
        positions=surface.positions + 0.2 * PIXEL * generator.normal(size=surface.positions.shape),
        spectra=surface.spectra * light,
    )
    moved = in_world(rough, MOVED)
    found = register(surface, moved, PIXEL)
    assert rms_px(found.to_before, MOVED.inverse, moved.positions) < 0.3
    assert found.overlap > 0.95
    assert 0.05 < found.rms_px < 0.4
    np.testing.assert_allclose(found.light, light, rtol=0.01)


def test_a_fixed_scale_is_taken_as_given(surface):
    moved = in_world(surface, MOVED)
    found = register(surface, moved, PIXEL, "fixed", 1 / MOVED.scale)
    assert found.to_before.scale == pytest.approx(1 / MOVED.scale, rel=1e-9)
    assert rms_px(found.to_before, MOVED.inverse, moved.positions) < 0.2
    with pytest.raises(ConfigError, match="can't be laid on each other"):
        register(surface, moved, PIXEL, "fixed", 1.0)


def part_of(surface, kept: np.ndarray):
    """Some vertices of a surface."""
    names = ("positions", "normals", "areas", "spectra", "abundances")
    parts = {name: getattr(surface, name)[kept] for name in names}
    return replace(surface, **parts, faces=np.zeros((0, 3), np.int64))


def test_a_part_of_the_object_is_found_on_the_whole(surface):
    found = register(part_of(surface, surface.positions[:, 2] > -0.35), surface, PIXEL)
    assert rms_px(found.to_before, Similarity.identity(), surface.positions) < 0.2


@pytest.mark.parametrize("scale", ["free", "fixed"])
def test_captures_of_different_sides_are_refused(surface, scale):
    """Whatever similarity lays one side on the other, it is not the same object there."""
    upper = part_of(surface, surface.positions[:, 2] > 0.25)
    lower = part_of(surface, surface.positions[:, 2] < -0.25)
    with pytest.raises(ConfigError, match="can't be laid on each other"):
        register(upper, in_world(lower, MOVED), PIXEL, scale, 1 / MOVED.scale)


def test_other_objects_and_other_materials_are_refused(surface):
    other = surface_of_shape(lambda directions: lumpy(directions[:, [2, 0, 1]]) ** 3)
    with pytest.raises(ConfigError, match="are they of one object"):
        register(surface, other, PIXEL)
    repainted = replace(surface, spectra=surface.spectra[:, ::-1] * [3.0, 0.2, 2.0, 0.1])
    with pytest.raises(ConfigError, match="same materials"):
        register(surface, in_world(repainted, MOVED), PIXEL)


MARKS = {
    str(index): np.array([0.3 * index - 1.0, (-1.0) ** index, -1.2]) + 0.1 * np.array(
        [[0, 1, 0], [1, 1, 0], [1, 0, 0], [0, 0, 0]], float
    )
    for index in range(6)
}  # fmt: skip
"""Corners of printed markers around the object."""
MARKS_LATER = {name: MOVED.apply(corners) for name, corners in MARKS.items()}


def test_markers_hold_a_plain_ball_that_surfaces_alone_do_not():
    ball = surface_of_shape(lambda directions: np.ones(len(directions)), spectra=np.full((2562, 4), 0.5))
    moved = in_world(ball, MOVED)
    found = register(ball, moved, PIXEL, markers=(MARKS, MARKS_LATER))
    assert rms_px(found.to_before, MOVED.inverse, moved.positions) < 0.3
    assert found.markers_px is not None
    assert found.markers_px < 0.3
    assert rms_px(register(ball, moved, PIXEL).to_before, MOVED.inverse, moved.positions) > 3.0


def test_a_marker_that_moved_is_left_out_and_said(surface):
    later = MARKS_LATER | {"2": MARKS_LATER["2"] + 10 * PIXEL}
    found = register(surface, in_world(surface, MOVED), PIXEL, markers=(MARKS, later))
    assert rms_px(found.to_before, MOVED.inverse, in_world(surface, MOVED).positions) < 0.2
    assert found.notes == ("markers that moved against the others are not used: 2",)


def test_markers_that_contradict_the_surface_do_not_decide_and_that_is_said(surface):
    moved = in_world(surface, MOVED)
    for later in (
        {name: corners + np.array([0.0, 8 * PIXEL, 0.0]) for name, corners in MARKS_LATER.items()},
        {name: 3.0 * corners[:, [1, 0, 2]] * [1, -1, 1] for name, corners in MARKS_LATER.items()},
    ):
        found = register(surface, moved, PIXEL, markers=(MARKS, later))
        assert rms_px(found.to_before, MOVED.inverse, moved.positions) < 0.2
        assert found.markers_px is None
        assert "contradict the surface" in found.notes[0]
    in_a_line = {name: corners[:1] * [1.0, 0.0, 0.0] for name, corners in MARKS.items()}
    assert register(surface, moved, PIXEL, markers=(in_a_line, in_a_line)).notes == ()


def test_the_way_back_undoes_a_similarity():
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_allclose(MOVED.inverse.apply(MOVED.apply(points)), points, atol=1e-12)


def test_light_is_a_median_that_changed_places_do_not_move():
    first = np.random.default_rng(0).uniform(0.2, 1.0, (200, 4))
    second = first * [1.2, 1.1, 1.0, 0.9]
    second[:60] *= 3.0
    found = light_between(first, second, np.ones(200), np.ones(4))
    np.testing.assert_allclose(found, [1.2, 1.1, 1.0, 0.9], rtol=1e-9)
    first[:, 2] = 0.0
    assert light_between(first, second, np.ones(200), np.full(4, 7.0))[2] == 7.0
