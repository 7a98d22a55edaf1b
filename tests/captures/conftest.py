"""What makes small scenes quick to write."""

import pytest


@pytest.fixture(autouse=True, scope="module")
def quick_scenes(no_wait_for_the_disk, coarse_hulls):
    """Nothing is forced to disk of the scenes and captures here, of which most are looked at once."""


@pytest.fixture(autouse=True)
def only_sheets_that_are_asked_for(no_contact_sheet):
    """Of them."""
