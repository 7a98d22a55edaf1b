"""Captures of few, small or empty views become scenes, or are refused with what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.factories.captures import process, write_poses
from unmix_plugin.errors import CaptureError

SIDE, BANDS = 16, 9
CENTRES = ",".join(str(450 + 50 * index) for index in range(BANDS))


def write_views(root: Path, views: int, values, side: int = SIDE) -> None:
    root.mkdir()
    names = [f"view_{index:02d}" for index in range(views)]
    for index, name in enumerate(names):
        np.save(root / f"{name}.npy", values(np.random.default_rng(index), (side, side, BANDS)))
    write_poses(root / "transforms.json", names, side, side)


def textured(generator, shape):
    return generator.uniform(0.1, 0.9, shape).astype(np.float32)


def plain(_, shape):
    return np.broadcast_to(np.linspace(0.2, 0.8, shape[-1]), shape).astype(np.float32)


def rimmed(generator, shape):
    values = textured(generator, shape)
    values[:2], values[-2:], values[:, :2], values[:, -2:] = (np.nan,) * 4
    return values


@pytest.mark.usefixtures("contact_sheet")
@pytest.mark.parametrize("mask", ["auto", "none"])
@pytest.mark.parametrize(("values", "views", "side"), [
    (textured, 2, 16), (textured, 9, 16), (textured, 9, 4), (rimmed, 9, 16), (rimmed, 2, 16),
])  # fmt: skip
def test_small_and_few_views_become_a_scene_with_their_values(tmp_path, values, views, side, mask):
    write_views(tmp_path / "capture", views, values, max(side, 8) if values is rimmed else side)
    process(tmp_path / "capture", tmp_path / "scene", wavelengths=CENTRES, mask=mask)
    written = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    assert len(written["frames"]) == views
    for frame in written["frames"]:
        name = Path(frame["file_path"]).stem
        given = np.load(tmp_path / "capture" / f"{name}.npy")
        stored = np.load(tmp_path / "scene" / "cubes" / f"{name}.npy") / 65535
        np.testing.assert_allclose(stored, np.nan_to_num(given), atol=1e-4)
        assert ("mask_path" in frame) == (values is rimmed)
    assert "What was decided" in (tmp_path / "scene" / "report.txt").read_text()


@pytest.mark.parametrize(("values", "views", "message"), [
    (textured, 1, "1 of 1 views has a pose; a scene needs 2"),
    (plain, 6, "0 of 9 bands are left.*dead: the same value in every sampled pixel"),
    (lambda _, shape: np.full(shape, np.nan, np.float32), 6, "no sampled pixel .* has a measurement"),
    (lambda _, shape: np.zeros(shape, np.uint16), 6, "0 of 9 bands are left"),
])  # fmt: skip
def test_what_shows_nothing_is_refused_with_the_reason(tmp_path, values, views, message):
    write_views(tmp_path / "capture", views, values)
    with pytest.raises(CaptureError, match=message):
        process(tmp_path / "capture", tmp_path / "scene", wavelengths=CENTRES)
