"""Which frames train and which evaluate."""

from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes.scene_factory import SceneFolder, make_scene
from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.reading.splits import Split, split_frames
from unmix_plugin.scenes.reading.transforms_json import FrameEntry, SceneEntry
from unmix_plugin.settings import SceneOptions


def entry_of(names: list[str], **lists: list[str]) -> SceneEntry:
    frames = tuple(
        FrameEntry(f"frames[{i}]", {"file_path": name}, None, None) for i, name in enumerate(names)
    )
    return SceneEntry(None, None, None, None, {key: tuple(value) for key, value in lists.items()}, frames)


def split_of(
    names: list[str],
    method: Literal["auto", "lists", "filename", "interval"] = "auto",
    interval: int = 8,
    **lists: list[str],
) -> Split:
    faults = Faults(Path("scene"))
    split = split_frames(entry_of(names, **lists), method, interval, faults)
    faults.raise_if_any()
    return split


def test_lists_go_before_names_and_order():
    names = ["train_0.png", "train_1.png", "test_2.png"]
    split = split_of(names, train=["test_2.png"], test=["train_0.png"])
    assert split == Split((2,), (0,))


def test_the_test_list_goes_before_the_validation_list():
    assert split_of(["a", "b", "c"], train=["a"], val=["b"], test=["c"]) == Split((0,), (2,))
    assert split_of(["a", "b", "c"], train=["a"], val=["b"]) == Split((0,), (1,))
    assert split_of(["a", "b", "c"], train=["a"], val=["b"], test=[]) == Split((0,), (1,))


def test_a_list_that_is_absent_is_what_the_others_leave():
    assert split_of(["a", "b", "c", "d"], train=["a", "c"]) == Split((0, 2), (1, 3))
    assert split_of(["a", "b", "c", "d"], val=["b"], test=["c"]) == Split((0, 3), (2,))


def test_lists_may_spell_a_path_in_another_way():
    assert split_of(
        ["./images/a.png", "images/b.png"], train=["images/a.png"], test=["images/./b.png"]
    ).train == (0,)


@pytest.mark.parametrize(
    "names",
    [
        ["train/r_0.png", "train/r_1.png", "test/r_0.png"],
        ["images/train_0.png", "images/train_1.png", "images/eval_2.png"],
        ["images/train-0.png", "images/training1.png", "images/val2.png"],
        ["a/b/Train/0.png", "a/b/Train/1.png", "a/b/Test/2.png"],
    ],
)
def test_folders_and_file_names_tell_the_split(names):
    assert split_of(names) == Split((0, 1), (2,))


def test_test_frames_go_before_validation_frames_by_name_too():
    assert split_of(["train_0", "val_1", "eval_2", "test_3"]) == Split((0,), (3,))
    assert split_of(["train_0", "val_1", "eval_2"]) == Split((0,), (1, 2))


def test_words_that_only_begin_like_a_split_are_no_split():
    with pytest.raises(SceneError, match="neither its folder nor its name starts with"):
        split_of(["images/train_0.png", "images/valley_1.png"], method="filename")
    assert split_of(["trainer_0.png", "testament_1.png"]) == Split((1,), (0,))  # every n-th instead


@given(st.integers(2, 40), st.integers(2, 12))
def test_every_nth_frame_evaluates_and_no_frame_is_lost_or_used_twice(count, interval):
    split = split_of([str(i) for i in range(count)], interval=interval)
    assert sorted(split.train + split.evaluation) == list(range(count))
    assert split.evaluation == tuple(range(0, count, interval))


@pytest.mark.parametrize("interval", [1, 0, -3])
def test_an_interval_that_leaves_nothing_to_train_on_is_refused(interval):
    with pytest.raises(SceneError, match="--eval-interval: is"):
        split_of(["a", "b"], method="interval", interval=interval)


def test_lists_that_are_asked_for_must_be_there():
    with pytest.raises(SceneError, match="--eval-split lists needs them"):
        split_of(["a", "b"], method="lists")


def test_the_options_choose_the_split_of_a_scene(tmp_path):
    folder: SceneFolder = make_scene(tmp_path / "scene")
    scene = load_scene(folder.root, SceneOptions(eval_split="interval", eval_interval=3))
    assert scene.eval_indices == (0, 3)
    assert scene.train_indices == (1, 2, 4, 5)
