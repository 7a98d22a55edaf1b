"""Judgements are kept by content: the same is not judged twice, and nothing that is out of date is taken."""

from dataclasses import dataclass, replace
from unittest import mock

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from tests.factories.scenes import make_scene
from unmix_plugin.datamanager import HyperspectralDataManager
from unmix_plugin.engine.decisions import Decision
from unmix_plugin.scenes import judged_views, kept
from unmix_plugin.scenes.kept import judged_once
from unmix_plugin.scenes.reading import loader
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.settings import HyperspectralDataManagerConfig, SceneOptions


@dataclass(frozen=True)
class Judged:
    numbers: Float[np.ndarray, " N"]
    places: Float[Tensor, "P 3"] | None
    decision: Decision
    names: tuple[str, ...] = ()


FOUND = Judged(
    np.array([0.1, np.nan, np.inf]),
    torch.rand(4, 3),
    Decision("world", "bounded", {"share": np.float64(0.25)}),
    ("a", "b"),
)


def never():
    raise AssertionError("judged again")


@pytest.mark.usefixtures("judged_before")
def test_the_same_is_not_judged_twice_and_comes_back_as_it_was():
    assert judged_once(Judged, {"files": {"a": "1"}}, lambda: FOUND) is FOUND
    again = judged_once(Judged, {"files": {"a": "1"}}, never)
    np.testing.assert_array_equal(again.numbers, FOUND.numbers)
    assert again.numbers.dtype == FOUND.numbers.dtype
    torch.testing.assert_close(again.places, FOUND.places, rtol=0, atol=0)
    assert (again.decision, again.names) == (FOUND.decision, FOUND.names)
    again.numbers[0] = 2.0  # may be written to
    assert judged_once(Judged, {"files": {"a": "2"}}, lambda: replace(FOUND, places=None)).places is None
    assert judged_once(Judged, {"files": {"a": "2"}}, never).places is None


@pytest.mark.parametrize("change", ["code", "library"])
def test_other_code_judges_again(judged_before, monkeypatch, change):
    judged_once(Judged, {}, lambda: FOUND)
    if change == "library":
        monkeypatch.setattr(kept, "version", lambda _: "99")
    else:
        monkeypatch.setattr(kept, "__file__", str(judged_before / "scenes" / "kept.py"))
    kept._code.cache_clear()
    with pytest.raises(AssertionError, match="judged again"):
        judged_once(Judged, {}, never)
    kept._code.cache_clear()


@pytest.mark.parametrize("content", [b"", b"no zip", None])
def test_what_cannot_be_read_is_judged_again(judged_before, content):
    judged_once(Judged, {}, lambda: FOUND)
    (path,) = judged_before.iterdir()
    path.write_bytes(path.read_bytes()[:40] if content is None else content)
    assert judged_once(Judged, {}, lambda: FOUND) is FOUND
    assert judged_once(Judged, {}, never).names == FOUND.names


def test_without_a_folder_to_write_into_nothing_is_kept(judged_before):
    judged_before.parent.parent.mkdir(parents=True)
    judged_before.parent.write_bytes(b"a file where the folder should be")
    for _ in range(2):
        assert judged_once(Judged, {}, lambda: FOUND) is FOUND


def test_the_judgements_not_used_for_longest_go_and_nothing_else(judged_before, monkeypatch):
    monkeypatch.setattr(kept, "_MOST_KEPT", 2)
    judged_before.mkdir(parents=True)
    (judged_before / "notes.txt").write_text("mine")
    for number in (0, 1, 0, 2):
        with mock.patch("os.utime"):  # times within a test are too close to each other
            judged_once(Judged, {"number": number}, lambda: FOUND)
        for age, path in enumerate(
            sorted(judged_before.glob("*.judged"), key=lambda each: each.stat().st_mtime_ns)
        ):
            assert age < 2, path
    assert (judged_before / "notes.txt").read_text() == "mine"


@pytest.mark.usefixtures("judged_before")
def test_a_scene_read_twice_is_judged_once_and_again_when_a_value_changes(tmp_path):
    folder = make_scene(tmp_path / "scene")
    options = SceneOptions()
    judge = mock.Mock(wraps=loader.find_model_space)
    with mock.patch.object(loader, "find_model_space", judge):
        first, second = load_scene(folder.root, options), load_scene(folder.root, options)
        assert judge.call_count == 1
        assert second.normalisation.to_json() == first.normalisation.to_json()
        assert second.scene_box.aabb.equal(first.scene_box.aabb)
        assert (second.decisions, second.warnings) == (first.decisions, first.warnings)
        load_scene(folder.root, replace(options, world="bounded"))
        folder.edit_cube(0, lambda cube: cube * 0.5)
        load_scene(folder.root, options)
        assert judge.call_count == 3


@pytest.mark.usefixtures("judged_before")
def test_a_second_training_has_the_same_initial_data(tmp_path):
    folder = make_scene(tmp_path / "scene")
    config = HyperspectralDataManagerConfig(train_num_rays_per_batch=64, grid_resolution=16)

    def begun() -> HyperspectralDataManager:
        return config.setup(data=folder.root, device=torch.device("cpu"), seed=0)

    first = begun().initial_data()
    with mock.patch.object(judged_views, "sweep_scene", never):
        second, third = begun(), replace(config, grid_resolution=8)
        assert second.decisions()
        assert list(second.warnings()) == list(begun().warnings())
    assert set(second.initial_data()) == set(first)
    for name, values in second.initial_data().items():
        np.testing.assert_array_equal(values, first[name])
    again = third.setup(data=folder.root, device=torch.device("cpu"), seed=0)
    assert again.initial_data()["reachable"].shape == (8, 8, 8)
