from collections.abc import Callable

import numpy as np
import pytest
import torch

from tests.factories.files import present
from tests.factories.scenes import widen
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes import pixel_block, pixel_table
from unmix_plugin.scenes.pixel_block import PixelBlock
from unmix_plugin.scenes.pixel_table import PixelTable
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.settings import SceneOptions

CPU = torch.device("cpu")
STORED = [("<f2", None), ("<f4", None), ("u1", 255.0), ("<i2", 10000.0), ("<u2", 60000.0)]
OTHERS = [("<f2", None), (">f4", None), ("u1", 255.0), ("<f8", None), (">u2", 65535.0)]


def as_stored(cube: np.ndarray, stored: str, scale: float | None) -> np.ndarray:
    return (cube * (scale or 1.0)).round(5).astype(stored)


def with_a_dead_value(index: int, cube: np.ndarray) -> np.ndarray:
    """The cube in ten smooth bands, and in view 3 a value of 0 in one of them."""
    wide = np.repeat(cube[..., 2:3].astype(np.float64), 10, axis=-1) * np.linspace(0.9, 1.0, 10)
    wide[8, 10, 4] *= index != 3
    return wide


def read_block(scene, views: tuple[int, ...]) -> PixelBlock:
    block = PixelBlock(scene, views, tuple(range(len(views))), CPU)
    block.hold()
    return block


@pytest.mark.parametrize(("stored", "scale"), [*STORED, (">f2", None), *OTHERS[3:], ("<i4", 10000.0)])
def test_pixels_are_those_of_the_scene_at_the_size_they_were_stored_in(folder, stored, scale):
    folder.edit_cubes(lambda cube: as_stored(cube.astype(float), stored, scale))
    scene = load_scene(folder.root, SceneOptions(value_scale=scale))
    block = read_block(scene, (1, 3))
    everything = torch.arange(len(block))
    expected = np.concatenate([scene.cube(view).reshape(-1, 4) for view in (1, 3)])
    assert torch.equal(block.spectra(everything), torch.from_numpy(expected))
    assert block.held_bytes == len(block) * 4 * min(np.dtype(stored).itemsize, 4)
    for row, view in enumerate((1, 3)):
        alpha = torch.from_numpy(present(scene.alpha(view)).reshape(-1))
        assert torch.equal(block.alpha[320 * row :][:320], alpha)


def test_clipped_pixels_come_out_clipped_and_views_of_different_types_as_single_precision(folder):
    folder.edit_cube(1, lambda cube: cube - np.float16(0.01) * (cube < 0.1))
    folder.edit_cube(3, lambda cube: cube.astype(np.float64))
    scene = load_scene(folder.root, SceneOptions(invalid_pixels="clip"))
    assert np.load(folder.root / "cubes/view_1.npy").min() < 0
    block = read_block(scene, (1, 3))
    assert block.spectra(torch.arange(320)).min() == 0.0
    expected = torch.from_numpy(scene.cube(3).reshape(-1, 4)[[180]])
    assert torch.equal(block.spectra(torch.tensor([500])), expected)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize(("stored", "scale"), OTHERS)
def test_pixels_on_disk_are_the_same_as_those_in_memory(folder, monkeypatch, stored, scale, order):
    folder.edit_cubes(lambda cube: np.asarray(as_stored(cube.astype(float), stored, scale), order=order))
    scene = load_scene(folder.root, SceneOptions(value_scale=scale))
    held, mapped = read_block(scene, (1, 3, 4)), PixelBlock(scene, (1, 3, 4), (0, 1, 2), CPU)
    mapped.hold_part(1)
    assert mapped.pool is not None
    pixels, values = mapped.pool.draw(200, 3, torch.Generator().manual_seed(0))
    expected, found = held.take(pixels, 7), mapped.take(pixels, 7, values)
    for name in ("numbers", "cameras", "corners", "spectra", "alpha"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
    assert torch.equal(mapped.spectra(pixels), expected.spectra)
    monkeypatch.setattr(pixel_block, "_CHUNK_VALUES", 3 * 20 * 4)

    def sums(spectra: torch.Tensor, alpha: torch.Tensor, valid: torch.Tensor) -> torch.Tensor:
        return spectra.sum(dim=1) + 10 * alpha + 100 * valid

    for view, one, other in zip((1, 3, 4), mapped.pictures(sums), held.pictures(sums), strict=True):
        assert torch.equal(one, other)
        own = scene.cube(view).sum(axis=-1) + 10 * present(scene.alpha(view)) + 100 * scene.valid_mask(view)
        torch.testing.assert_close(one, torch.from_numpy(own).float())


def test_pixels_are_held_unless_they_need_more_than_the_budget(folder, monkeypatch):
    scene = load_scene(folder.root)
    needed = 5 * 320 * (4 * 2 + 5)
    monkeypatch.setattr(pixel_table, "available_bytes", lambda _: 2 * needed)
    assert PixelTable(scene, CPU, scene.train_indices).notes == []
    assert PixelTable(scene, CPU, scene.train_indices, memory_gb=(needed + 2) / 0.85 / 2**30).notes == []
    [note] = PixelTable(scene, CPU, scene.train_indices, memory_gb=(needed - 2) / 0.85 / 2**30).notes
    assert "5 views x 16 x 20 pixels x 4 bands x 2 bytes are 1.94e-05 GiB" in note
    monkeypatch.setattr(pixel_table, "available_bytes", lambda _: needed)
    assert PixelTable(scene, CPU, scene.train_indices).notes != []


@pytest.mark.parametrize("components", ["none", 3])
@pytest.mark.parametrize(("stored", "scale"), STORED)
def test_pixels_are_mended_whole_or_projected_and_kept_as_small(folder, stored, scale, components):
    widen(folder, 10, lambda index, cube: as_stored(with_a_dead_value(index, cube), stored, scale))
    scene = load_scene(folder.root, SceneOptions(value_scale=scale))
    size = PixelTable(scene, CPU, (1, 3), components=components).blocks[0].held_bytes
    table = PixelTable(scene, CPU, (1, 3), mends=True, components=components)
    assert table.bad_share == pytest.approx(1 / (2 * 320 * 10))
    mended = table.blocks[0].spectra(torch.tensor([320 + 8 * 20 + 10]))[0]
    assert torch.allclose(mended, torch.from_numpy(scene.cube(1)[8, 10]), atol=0.01)
    assert table.blocks[0].held_bytes == size or components == 3


@pytest.mark.parametrize("components", ["none", 3])
@pytest.mark.parametrize(("stored", "scale"), [STORED[0], STORED[1], STORED[4]])
def test_views_are_never_read_whole_and_all_is_mended(folder, monkeypatch, stored, scale, components):
    """Bad values at the edges of parts too."""

    def write(_: int, cube: np.ndarray) -> np.ndarray:
        bright = 0.5 + 0.1 * np.sin(np.arange(cube.shape[1]) + np.arange(cube.shape[0])[:, None])
        wide = bright[..., None] * np.linspace(0.9, 1.0, 10)
        wide[[7, 7, 8, 9], [10, 11, 11, 9], [4, 2, 7, 0]] = 0.0
        return as_stored(wide, stored, scale)

    scene = load_scene(widen(folder, 10, write).root, SceneOptions(value_scale=scale))
    whole = PixelTable(scene, CPU, scene.train_indices, mends=True, components=components)
    assert whole.bad_share == pytest.approx(4 / (320 * 10))
    monkeypatch.setattr(pixel_block, "_CHUNK_VALUES", 4 * 20 * 10)
    monkeypatch.setattr(pixel_block, "_FEWEST_ROWS", 1)
    rows = []

    def counting(read: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
        def counted(scene: Scene, view: int, part: tuple = ()) -> np.ndarray:
            if part and isinstance(part[0], slice):
                rows.append(part[0].stop - part[0].start)
            return read(scene, view, part)

        return counted

    for name in ("stored_cube", "cube"):
        monkeypatch.setattr(Scene, name, counting(getattr(Scene, name)))
    parts = PixelTable(scene, CPU, scene.train_indices, mends=True, components=components)
    assert max(rows) == (8 if components == 3 else 4)
    assert parts.bad_share == whole.bad_share
    everything = torch.arange(len(parts))
    assert torch.equal(parts.blocks[0].spectra(everything), whole.blocks[0].spectra(everything))


@pytest.mark.parametrize("components", ["none", 3])
def test_a_value_beside_pixels_without_a_measurement_is_mended_by_the_others(folder, components):
    def write(index: int, cube: np.ndarray) -> np.ndarray:
        wide = with_a_dead_value(index, cube)
        wide[8, 11] = np.nan
        return wide.astype(np.float16)

    widen(folder, 10, write)
    scene = load_scene(folder.root, SceneOptions(invalid_pixels="mask"))
    [block] = PixelTable(scene, CPU, (1, 3), mends=True, components=components).blocks
    assert block.num_bad == 1
    found, expected = block.spectra(torch.tensor([320 + 8 * 20 + 10]))[0], torch.from_numpy(scene.cube(1))
    assert torch.allclose(found, expected[8, 10], atol=0.01)


BRIGHTEST = [("<f4", None), ("<f2", None), ("u1", 255.0), ("u1", 1000.0), ("<i2", 60000.0), ("<u2", 65535.0)]


@pytest.mark.parametrize(("stored", "scale"), BRIGHTEST)
def test_what_is_mended_is_at_most_full_scale_and_the_largest_number_of_its_type(folder, stored, scale):
    """Beside a bad value a pixel is as bright as can be, and the pixels around have a peak there."""
    dtype, components = np.dtype(stored), 3 if stored == "<f2" else "none"
    largest = 1.0 if dtype.kind == "f" else min(np.iinfo(dtype).max / (scale or 1.0), 1.0)

    def write(index: int, cube: np.ndarray) -> np.ndarray:
        is_peak = np.arange(10) == 4
        wide = largest * np.tile(np.where(is_peak, 1.0, 0.8), (*cube.shape[:2], 1))
        if index == 3:
            wide[8, 10] = largest * ~is_peak
        return as_stored(wide, stored, scale)

    scene = load_scene(widen(folder, 10, write).root, SceneOptions(value_scale=scale))
    [block] = PixelTable(scene, CPU, (1, 3), mends=True, components=components).blocks
    assert block.num_bad == 1
    found = block.spectra(torch.tensor([320 + 8 * 20 + 10]))[0]
    assert torch.allclose(found, torch.full((10,), largest), atol=0.01 * largest)


def test_a_cube_that_is_cut_short_while_training_goes_on_is_named(folder):
    scene = load_scene(folder.root)
    block = PixelBlock(scene, (1, 3), (0, 1), CPU)
    block.hold_part(1)
    path = folder.root / "cubes/view_3.npy"
    path.write_bytes(path.read_bytes()[:-100])
    assert block.pool is not None
    with pytest.raises(SceneError, match=r"view_3\.npy: the cube can't be read any more .*must stay as it"):
        block.pool.draw(10, 0, torch.Generator().manual_seed(0))
