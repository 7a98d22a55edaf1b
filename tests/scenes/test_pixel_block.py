"""Pixels come out of a block as the scene has them, whatever they were stored as, and need little memory."""

import numpy as np
import pytest
import torch

from tests.scenes.scene_factory import make_scene
from unmix_plugin.errors import ConfigError
from unmix_plugin.scenes import SceneOptions, load_scene
from unmix_plugin.scenes.pixel_table import PixelTable, memory
from unmix_plugin.scenes.pixel_table.block import PixelBlock
from unmix_plugin.scenes.pixel_table.memory import available_bytes

CPU = torch.device("cpu")


def read_block(scene, views: tuple[int, ...]) -> PixelBlock:
    block = PixelBlock(scene, views, tuple(range(len(views))))
    block.read(CPU)
    return block


@pytest.mark.parametrize(
    ("stored", "scale", "num_bytes"),
    [
        ("<f2", None, 2),
        (">f2", None, 2),
        ("<f4", None, 4),
        ("<f8", None, 4),
        ("u1", 255.0, 1),
        ("<i2", 10000.0, 2),
        ("<u2", 60000.0, 2),
        (">u2", 65535.0, 2),
        ("<i4", 10000.0, 4),
    ],
)
def test_pixels_are_those_of_the_scene_at_the_size_they_were_stored_in(tmp_path, stored, scale, num_bytes):
    folder = make_scene(tmp_path / "scene")
    folder.edit_cubes(lambda cube: (cube.astype(np.float64) * (scale or 1.0)).round(5).astype(stored))
    scene = load_scene(folder.root, SceneOptions(value_scale=scale))
    block = read_block(scene, (1, 3))
    everything = torch.arange(len(block))
    expected = np.concatenate([scene.cube(view).reshape(-1, 4) for view in (1, 3)])
    assert torch.equal(block.spectra(everything), torch.from_numpy(expected))
    assert block._values.element_size() == num_bytes
    for row, view in enumerate((1, 3)):
        alpha = scene.alpha(view)
        assert alpha is not None
        assert torch.equal(block.alpha[320 * row :][:320], torch.from_numpy(alpha.reshape(-1)))


def test_views_of_different_types_are_kept_as_single_precision(tmp_path):
    folder = make_scene(tmp_path / "scene").edit_cube(3, lambda cube: cube.astype(np.float64))
    scene = load_scene(folder.root)
    block = read_block(scene, (1, 3))
    assert torch.equal(
        block.spectra(torch.tensor([500])), torch.from_numpy(scene.cube(3).reshape(-1, 4)[[180]])
    )


def test_clipped_pixels_come_out_clipped(tmp_path):
    folder = make_scene(tmp_path / "scene").edit_cube(1, lambda cube: cube - np.float16(0.01) * (cube < 0.1))
    scene = load_scene(folder.root, SceneOptions(invalid_pixels="clip"))
    assert np.load(folder.root / "cubes/view_1.npy").min() < 0
    assert read_block(scene, (1,)).spectra(torch.arange(320)).min() == 0.0


def test_pixels_that_do_not_fit_are_refused_with_sizes_before_any_is_read(tmp_path, monkeypatch):
    scene = load_scene(make_scene(tmp_path / "scene").edit_cubes(lambda cube: cube.astype("f4")).root)
    monkeypatch.setattr(memory, "available_bytes", lambda _: 10_000)
    monkeypatch.setattr(type(scene), "cube", lambda *_: pytest.fail("a cube was read"))
    with pytest.raises(ConfigError, match=r"5 views x 16 x 20 pixels x 4 bands x 4 bytes need .* available"):
        PixelTable(scene, CPU, scene.train_indices)


def test_the_memory_left_is_known_on_this_machine():
    left = available_bytes(CPU)
    assert left is not None
    assert left > 2**20
