"""What the spectrum of a place is compared with."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch

from tests.method_factory import make_scene
from tests.scenes import scene_factory
from unmix_plugin.engine.processes import ALONE
from unmix_plugin.products.product import Job
from unmix_plugin.products.spectrum import _read_pixel
from unmix_plugin.scenes.reading.loader import load_scene


def test_what_a_training_view_measured_is_as_exposed_as_the_trained_scene(tmp_path):
    scene = load_scene(scene_factory.make_scene(tmp_path / "ball").root)
    gains, said = torch.rand(len(scene.train_indices), len(scene.wavelengths_nm)) + 0.5, []
    trained = replace(make_scene(), view_gains=gains)
    loaded = SimpleNamespace(materials_scene=trained, record=SimpleNamespace(summary={}))
    quiet = (said.append, lambda _: nullcontext(), lambda _, items: iter(items))
    job = Job(cast("Any", loaded), tmp_path, False, *quiet, ALONE)
    row, column = np.argwhere(scene.cube(0).sum(axis=-1) > 0)[0].tolist()
    for number, index in enumerate(scene.train_indices):
        expected = scene.cube(index)[row, column] / gains[number].numpy()
        np.testing.assert_allclose(_read_pixel(job, scene, index, column, row), expected, rtol=1e-5)
    assert said == []
    index = scene.eval_indices[0]
    assert _read_pixel(job, scene, index, column, row).tolist() == scene.cube(index)[row, column].tolist()
    assert f"no exposure was fitted to {scene.frames[index].name}" in said[0]
