"""What the spectrum of a place is compared with."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from tests.scenes.scene_factory import make_scene
from unmix_plugin.products.spectrum import _read_pixel
from unmix_plugin.scenes.reading.loader import load_scene


def test_what_a_training_view_measured_is_as_exposed_as_the_trained_scene(tmp_path):
    scene, said = load_scene(make_scene(tmp_path / "ball").root), []
    gains = torch.rand(len(scene.train_indices), len(scene.wavelengths_nm)) + 0.5
    record = SimpleNamespace(record=SimpleNamespace(summary={}))
    job: Any = SimpleNamespace(
        scene=SimpleNamespace(view_gains=gains, light_power=None), loaded=record, say=said.append
    )
    row, column = np.argwhere(scene.cube(0).sum(axis=-1) > 0)[0].tolist()
    for number, index in enumerate(scene.train_indices):
        expected = scene.cube(index)[row, column] / gains[number].numpy()
        np.testing.assert_allclose(_read_pixel(job, scene, index, column, row), expected, rtol=1e-5)
    assert said == []
    index = scene.eval_indices[0]
    assert _read_pixel(job, scene, index, column, row).tolist() == scene.cube(index)[row, column].tolist()
    assert f"no exposure was fitted to {scene.frames[index].name}" in said[0]
