"""What tests of many rooms share."""

import os

import pytest


@pytest.fixture(scope="module")
def no_wait_for_the_disk():
    """Hundreds of small files would otherwise be forced to disk one by one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _descriptor: None)
        yield
