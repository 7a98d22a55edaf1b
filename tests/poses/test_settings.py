"""When poses are refined: the grid joins level by level, line cameras are registered now and then."""

import numpy as np
import pytest

from unmix_plugin.errors import ConfigError
from unmix_plugin.poses.settings import PoseConfig


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


def test_impossible_settings_are_refused():
    with pytest.raises(ConfigError, match="coarse-until in"):
        PoseConfig(coarse_until=1.5)


@pytest.mark.parametrize(
    "wrong",
    [{"register_from": -0.1}, {"register_from": 1.5}, {"register_every": 0.0}, {"register_every": 2.0}],
)
def test_parts_of_the_training_that_are_none_are_refused(wrong):
    with pytest.raises(ConfigError, match=r"register-(from|every)"):
        PoseConfig(**wrong)


def test_line_cameras_are_not_registered_while_the_grid_is_coarse():
    config = PoseConfig(
        coarse_until=0.5, coarse_steps=60, register_from=0.0, register_every=0.25, register_steps=1
    )
    assert [step for step in range(100) if config.registers(step, step / 100)] == [75]
    assert [step for step in range(200) if config.registers(step, step / 200)] == [100, 150]


def test_short_trainings_are_registered_more_seldom():
    config = PoseConfig(coarse_steps=0, register_from=0.2, register_every=0.1, register_steps=30)
    assert [step for step in range(1, 100) if config.registers(step, step / 100)] == [20, 50, 80]


def test_scenes_are_learnt_anew_when_the_grid_is_fine_and_the_part_of_the_training_is_over():
    config = PoseConfig(coarse_until=0.5, coarse_steps=10**6, register_from=0.2, anew_from=0.3)
    assert [step for step in range(100) if config.begins_anew(step, step / 100)] == list(range(50, 66))
    assert not any(PoseConfig(anew_from=1.0).begins_anew(step, step / 100) for step in range(101))


def test_scenes_are_not_learnt_anew_before_line_cameras_are_registered():
    config = PoseConfig(coarse_steps=0, register_from=0.8, anew_from=0.3)
    assert [step for step in range(100) if config.begins_anew(step, step / 100)] == list(range(80, 91))


def test_registration_from_the_end_on_is_none_at_all():
    config = PoseConfig(coarse_steps=0, register_from=1.0)
    assert not any(config.registers(step, step / 100) for step in range(100))
