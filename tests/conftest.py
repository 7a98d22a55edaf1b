"""What tests of many rooms share."""

import os

import pytest


@pytest.fixture(scope="module")
def no_wait_for_the_disk():
    """Hundreds of small files would otherwise be forced to disk one by one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _descriptor: None)
        yield


@pytest.fixture
def contact_sheet():
    """For tests that want the contact sheet of the scenes that they write."""


@pytest.fixture
def no_contact_sheet(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch):
    """Scenes are written without one where no test asks for it: drawing takes longer than all else of small ones."""
    if "contact_sheet" not in request.fixturenames:
        monkeypatch.setattr("unmix_plugin.captures.writing.scene_files.contact_sheet", lambda *_: b"")
