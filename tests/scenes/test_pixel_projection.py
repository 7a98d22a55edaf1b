import numpy as np
import pytest
import torch

from tests.factories.scenes import make_scene, widen
from unmix_plugin.errors import SpectrumError
from unmix_plugin.scenes import pixel_table
from unmix_plugin.scenes.pixel_projection import ProjectedPixels, Projection
from unmix_plugin.scenes.pixel_table import PixelTable
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene

CPU = torch.device("cpu")
BANDS = 48
VIEWS = (0, 1, 2, 3, 4)
WHOLE = 5 * 320 * (2 * BANDS + 5)
"""Bytes of all pixels of these views with all of their bands."""


@pytest.fixture(autouse=True)
def few_bands_are_enough(monkeypatch):
    """So that the few opaque pixels of a tiny scene tell their subspace."""
    monkeypatch.setattr(pixel_table, "FEWEST_CHANNELS", BANDS)


SMOOTH = np.exp(-(((np.linspace(0, 1, BANDS) - np.array([[0.1], [0.5], [0.9]])) / 0.3) ** 2))


def spectra_of(cube: np.ndarray, change=None) -> np.ndarray:
    """From four bands to `BANDS` that mix three smooth spectra."""
    wide = cube[..., :3].astype(np.float64) @ SMOOTH
    height, width = cube.shape[:2]
    wide *= 1 + 0.3 * np.sin(np.arange(width))[:, None] * np.cos(np.arange(height))[:, None, None] * SMOOTH[1]
    if change is not None:
        change(wide)
    return wide.clip(0, 1).astype("<f2")


def make(folder, change=None) -> Scene:
    wide = widen(make_scene(folder), BANDS, lambda i, cube: spectra_of(cube, change if i == 3 else None))
    return load_scene(wide.root)


def test_odd_and_saturated_pixels_are_kept_whole():
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(2000, 3, generator=generator) @ torch.from_numpy(SMOOTH).float() / 3
    projection = Projection(pixels, 3)
    pixels[700], pixels[1700, 4:7] = torch.rand(BANDS, generator=generator), 1.0
    held = ProjectedPixels(projection, 2000, CPU)
    for first in (0, 1000):
        held.put(first, pixels[first : first + 1000])
    assert torch.equal(held.spectra(torch.tensor([1700, 3, 700]))[[0, 2]], pixels[[1700, 700]].half().float())
    others = torch.tensor([index for index in range(2000) if index not in (700, 1700)])
    torch.testing.assert_close(held.spectra(others), pixels[others], atol=1e-3, rtol=0)
    assert held.num_bytes == 2000 * 3 * 2 + 2 * (8 + 2 * BANDS)
    assert Projection(pixels, 3).whole_share == pytest.approx(0.002)


def test_pixels_that_do_not_fit_are_projected_and_drawn_as_if_they_were_held(tmp_path, monkeypatch):
    scene = make(tmp_path / "scene")
    plain = PixelTable(scene, CPU, VIEWS)
    monkeypatch.setattr(pixel_table, "available_bytes", lambda _: WHOLE)
    few = PixelTable(scene, CPU, VIEWS, components="auto")
    [note] = few.notes
    assert f"instead of {BANDS} (target-components)" in note
    [found], [expected] = (table.draw(300, torch.Generator().manual_seed(1), 7) for table in (few, plain))
    for name in ("numbers", "cameras", "corners", "alpha"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
    assert float((found.spectra - expected.spectra).square().mean().sqrt()) < 0.004
    assert torch.equal(found.spectra[expected.alpha == 0], expected.spectra[expected.alpha == 0])


def test_auto_projects_neither_what_fits_nor_what_has_no_subspace(tmp_path, monkeypatch):
    def rough(cube: np.ndarray) -> None:
        cube += 0.4 * np.random.default_rng(0).random(cube.shape)

    scene = make(tmp_path / "scene")
    fits = PixelTable(scene, CPU, VIEWS, components="auto")
    assert fits.notes == []
    everything, whole = torch.arange(1600), PixelTable(scene, CPU, VIEWS)
    assert torch.equal(fits.blocks[0].spectra(everything), whole.blocks[0].spectra(everything))
    monkeypatch.setattr(pixel_table, "available_bytes", lambda _: WHOLE)
    [note] = PixelTable(make(tmp_path / "rough", rough), CPU, VIEWS, components="auto").notes
    assert "stay on disk" in note


def test_a_given_number_is_taken_and_its_residual_said_or_that_it_does_not_make_the_pixels_fit(tmp_path):
    scene = make(tmp_path / "scene")
    [note] = PixelTable(scene, CPU, VIEWS, components=2).notes
    assert f"kept as 2 numbers instead of {BANDS}" in note
    assert PixelTable(scene, CPU, VIEWS, memory_gb=1e-4, components=2).notes == [note]
    assert PixelTable(scene, CPU, VIEWS, components=BANDS).notes == []
    with pytest.raises(SpectrumError, match="more pixels than bands"):
        PixelTable(scene, CPU, (1,), components=2)
    pool, ignored = PixelTable(scene, CPU, VIEWS, memory_gb=1e-6, components=2).notes
    assert "stay on disk" in pool
    assert ignored.startswith("target-components 2 has no effect: ")
    [automatic] = PixelTable(scene, CPU, VIEWS, memory_gb=1e-6, components="auto").notes
    assert "no effect" not in automatic


def test_how_many_pixels_stay_whole_is_judged_by_components_as_they_are_stored():
    pixels = (
        torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) @ torch.from_numpy(SMOOTH).float()
    )
    pixels[1::4] = pixels[2::4] = pixels[3::4] = 0  # before a black backdrop, to which noise is compared
    pixels = (
        pixels[torch.randperm(4000, generator=torch.Generator().manual_seed(1))] * 10_000
    ).round() / 60_000  # half precision has fewer digits
    projection = Projection(pixels, 3)
    held = ProjectedPixels(projection, 4000, CPU, most_bytes=1 << 30)
    assert held.put(0, pixels)
    kept = (held.num_bytes - 4000 * 2 * 3) / (2 * BANDS + 8) / 4000
    assert projection.whole_share > 0.1
    assert projection.whole_share == pytest.approx(kept, abs=0.03)


def test_pixels_stay_on_disk_where_more_must_be_kept_whole_than_some_pixels_told(tmp_path, monkeypatch):
    scene, judged = make(tmp_path / "scene"), pixel_table.Projection

    def misled(pixels: torch.Tensor, _: int | None) -> Projection:
        """By pixels that are all alike."""
        found = judged(pixels * 0 + pixels.mean(dim=0), 1)
        found.residual, found.whole_share = 0.0, 0.0
        return found

    monkeypatch.setattr(pixel_table, "Projection", misled)
    needed = len(VIEWS) * 320 * (5 + 2)
    for spare, expected in ((0.5 * WHOLE, "kept as 1 numbers"), (3 * BANDS, "stay on disk")):
        available = int((needed + spare) / 0.8)
        monkeypatch.setattr(pixel_table, "available_bytes", lambda _, available=available: available)
        table = PixelTable(scene, CPU, VIEWS, components="auto")
        assert expected in table.notes[0]
    [drawn] = table.draw(50, torch.Generator().manual_seed(1), 7)
    assert torch.equal(drawn.spectra, table.blocks[0].spectra(drawn.numbers))
