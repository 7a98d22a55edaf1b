"""What makes small scenes quick to write."""

import pytest


@pytest.fixture(autouse=True, scope="module")
def nothing_is_forced_to_disk(no_wait_for_the_disk):
    """Of scenes that are looked at once."""
