"""Curves of a training in a bounded number of points."""

import numpy as np

from unmix_plugin.engine.training.progress import TrainingStatus
from unmix_plugin.viewer.session import TrainingCurve


def status(step, psnr: float | None = 20.0):
    return TrainingStatus(step, float(step), step / 10_000, 1.0 / step, psnr, 100.0)


def test_a_short_curve_has_every_point_once():
    curve = TrainingCurve()
    for step in (1, 2, 2, 3, 1):
        curve.add(status(step))
    curve.add(None)
    steps, losses = curve.line("loss")
    assert steps.tolist() == [1, 2, 3]
    assert losses.tolist() == [1, 1 / 2, 1 / 3]


def test_a_long_curve_stays_small_and_covers_the_whole_training():
    curve = TrainingCurve()
    for step in range(1, 10_001):
        curve.add(status(step))
    steps, losses = curve.line("loss")
    assert 100 <= len(steps) <= 400
    assert steps[0] == 1
    assert steps[-1] > 9_900
    np.testing.assert_allclose(losses, 1 / steps)
    assert np.ptp(np.diff(steps)) == 0


def test_a_training_without_psnr_has_no_curve_of_it():
    curve = TrainingCurve()
    curve.add(status(1, None))
    steps, values = curve.line("psnr")
    assert len(steps) == len(values) == 0
