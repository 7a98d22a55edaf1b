"""Training ends at whichever limit is reached first, and progress says how near that is."""

import contextlib
import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.runs.load_run import load_config
from unmix_plugin.engine.training.limits import Limits, TrainingClock
from unmix_plugin.engine.training.trainer import Trainer

limits = st.builds(
    Limits,
    max_steps=st.none() | st.integers(0, 10_000),
    max_seconds=st.none() | st.floats(1e-3, 1e4),
)
steps, seconds = st.integers(0, 20_000), st.floats(0, 2e4)


@given(limits, steps, seconds)
def test_progress_is_the_nearer_limits_fraction(limit: Limits, step: int, spent: float):
    progress = limit.progress(step, spent)
    assert 0.0 <= progress <= 1.0
    over = [
        limit.max_steps is not None and step >= limit.max_steps,
        limit.max_seconds is not None and spent >= limit.max_seconds,
    ]
    assert limit.reached(step, spent) == any(over) == (progress == 1.0)
    if not any(over) and limit.max_steps and limit.max_seconds is None:
        assert progress == step / limit.max_steps


@given(limits, steps, seconds, st.integers(0, 100), st.floats(0, 100))
def test_progress_never_falls(limit: Limits, step: int, spent: float, more: int, longer: float):
    assert limit.progress(step + more, spent + longer) >= limit.progress(step, spent)


def test_the_clock_counts_only_while_it_runs():
    clock = TrainingClock(seconds=10.0)
    time.sleep(0.03)
    assert clock.seconds == 10.0
    with clock.running():
        time.sleep(0.03)
    assert 10.03 <= clock.seconds < 10.5
    with contextlib.suppress(ValueError), clock.running():
        time.sleep(0.01)
        raise ValueError
    assert clock.seconds >= 10.04


def test_a_limit_in_seconds_ends_training_in_time_with_the_schedule_run_out(short_config: TrainerConfig):
    trainer = Trainer(replace(short_config, max_num_iterations=None, max_seconds=0.5, steps_per_save=0))
    record = trainer.train()
    assert 0.5 <= record.train_seconds < 1.5
    assert record.progress == 1.0
    assert record.learning_rates["fields"] < 0.2 * 0.2
    assert record.steps > 12
    resumed = Trainer(replace(load_config(trainer.run.path), max_seconds=0.8)).train()
    assert 0.8 <= resumed.train_seconds < 1.8
    assert resumed.steps > record.steps


def test_seconds_of_evaluation_saving_and_warming_up_do_not_count(
    short_config: TrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    trainer = Trainer(
        replace(short_config, max_num_iterations=3, steps_per_eval_all_images=1, steps_per_save=1)
    )
    slow = {"eval": 0, "warm": 0}

    def evaluate():
        slow["eval"] += 1
        time.sleep(0.4)
        return {"psnr": 1.0}, {}

    def warm_up() -> None:
        slow["warm"] += 1
        time.sleep(0.4)

    monkeypatch.setattr(trainer.pipeline, "get_average_eval_image_metrics_and_images", evaluate)
    monkeypatch.setattr(trainer.pipeline.model, "warm_up", warm_up)
    record = trainer.train()
    assert slow == {"eval": 3, "warm": 1}
    assert record.train_seconds < 0.4
