"""The contact sheet shows every view with the outline of its mask."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from tests.captures.checks.view_factory import ball_points, ring_of, view_at
from unmix_plugin.captures.contact_sheet import OUTLINE, Spectra, contact_sheet


def test_every_view_stands_on_the_sheet_with_its_outline(tmp_path: Path):
    views = [view_at(tmp_path, f"view_{i}", place, None) for i, place in enumerate(ring_of(7))]
    nm = np.linspace(400.0, 700.0, 5)
    spectra = Spectra("", nm, np.ones((7, 5)), np.array([450.0]))
    points = ball_points(200)
    colours = np.full((200, 3), 128, np.uint8)
    sheet = contact_sheet(views, [spectra], points, colours, "seven views")
    pixels = np.asarray(Image.open(io.BytesIO(sheet)).convert("RGB")).astype(int)
    outline = np.abs(pixels - np.array(OUTLINE)).max(axis=-1) < 40
    columns = np.flatnonzero(outline.any(axis=0))
    rows = np.flatnonzero(outline.any(axis=1))
    assert (np.diff(columns) > 10).sum() + 1 == 4  # columns of the grid
    assert (np.diff(rows) > 10).sum() + 1 == 2  # and rows
