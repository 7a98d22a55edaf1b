"""Training ends at whichever limit is reached first, and progress says how near that is."""

import contextlib
from dataclasses import replace
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.runs.load_run import load_config
from unmix_plugin.engine.training import progress as limits_module
from unmix_plugin.engine.training.progress import Limits, TrainingClock
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


@pytest.fixture
def fake_time(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A clock that goes on by `tick` whenever it is read, and by hand."""
    fake = SimpleNamespace(now=0.0, tick=0.0)

    def read() -> float:
        fake.now += fake.tick
        return fake.now

    monkeypatch.setattr(limits_module, "time", SimpleNamespace(perf_counter=read))
    return fake


def test_the_clock_counts_only_while_it_runs(fake_time):
    clock = TrainingClock(seconds=10.0)
    fake_time.now = 5.0
    assert clock.seconds == 10.0
    with clock.running():
        fake_time.now += 3.0
    assert clock.seconds == 13.0
    with contextlib.suppress(ValueError), clock.running():
        fake_time.now += 1.0
        raise ValueError
    assert clock.seconds == 14.0


def test_a_limit_in_seconds_ends_training_in_time_with_the_schedule_run_out(
    short_config: TrainerConfig, fake_time
):
    fake_time.tick = 1 / 64
    trainer = Trainer(replace(short_config, max_num_iterations=None, max_seconds=0.5, steps_per_save=0))
    record = trainer.train()
    assert (record.steps, record.train_seconds) == (32, 0.5)
    assert record.progress == 1.0
    assert record.learning_rates["fields"] < 0.2 * 0.2
    resumed = Trainer(replace(load_config(trainer.run.path), max_seconds=0.75)).train()
    assert (resumed.steps, resumed.train_seconds) == (48, 0.75)


def test_seconds_of_evaluation_saving_and_warming_up_do_not_count(
    short_config: TrainerConfig, monkeypatch: pytest.MonkeyPatch, fake_time
):
    fake_time.tick = 1 / 64
    trainer = Trainer(
        replace(short_config, max_num_iterations=3, steps_per_eval_all_images=1, steps_per_save=1)
    )
    slow = {"eval": 0, "warm": 0}

    def evaluate():
        slow["eval"] += 1
        fake_time.now += 400
        return {"psnr": 1.0}, {}

    def warm_up() -> None:
        slow["warm"] += 1
        fake_time.now += 400

    monkeypatch.setattr(trainer.pipeline, "get_average_eval_image_metrics_and_images", evaluate)
    monkeypatch.setattr(trainer.pipeline.model, "warm_up", warm_up)
    record = trainer.train()
    assert slow == {"eval": 3, "warm": 1}
    assert record.train_seconds == 3 / 64
