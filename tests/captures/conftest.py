"""What makes small scenes quick to write."""

import pytest

from unmix_plugin.captures.writing import scene_files


@pytest.fixture(autouse=True, scope="module")
def nothing_is_forced_to_disk(no_wait_for_the_disk):
    """Of the scenes and captures here, of which most are looked at once."""


@pytest.fixture
def no_contact_sheet(monkeypatch: pytest.MonkeyPatch):
    """For scenes of plain views; drawing it would take three quarters of their time."""
    monkeypatch.setattr(scene_files, "contact_sheet", lambda *_: b"")
