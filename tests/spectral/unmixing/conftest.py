"""A shorter pooled search."""

import pytest

from unmix_plugin.spectral.unmixing import pooled_search


@pytest.fixture
def few_searches(monkeypatch):
    """For tests that ask for the same result twice rather than for a good one."""
    for name, value in (("_REPEATS", 1), ("_OUTER_STEPS", 6), ("_PURITY_PRICES", (0.0, 0.1, 0.3))):
        monkeypatch.setattr(pooled_search, name, value)
