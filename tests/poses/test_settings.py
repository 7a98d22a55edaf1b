"""When poses are refined: the grid joins level by level."""

import numpy as np

from unmix_plugin.settings import PoseConfig


def test_levels_of_the_grid_join_the_coarsest_first():
    weights = [PoseConfig().level_weights(5, share) for share in np.linspace(0, 1, 9)]
    assert weights[0] == [1.0, 0.0, 0.0, 0.0, 0.0]
    assert weights[-1] == [1.0] * 5
    assert (np.diff(np.array(weights), axis=0) >= 0).all()
    assert (np.diff(np.array(weights), axis=1) <= 0).all()


def test_the_coarse_part_is_a_part_of_the_training_and_never_longer_than_its_steps():
    config = PoseConfig(coarse_until=0.4, coarse_steps=500)
    assert [config.fineness(step, step / 1000) for step in (0, 100, 200, 400, 900)] == [0, 0.25, 0.5, 1, 1]
    assert [config.fineness(step, step / 10_000) for step in (0, 125, 250, 500)] == [0, 0.25, 0.5, 1]
    assert PoseConfig(coarse_until=0.0).fineness(0, 0.0) == 1.0
    assert PoseConfig(coarse_steps=0).fineness(0, 0.0) == 1.0
