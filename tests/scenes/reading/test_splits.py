from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import SceneError
from unmix_plugin.scenes.folder import SceneKeys
from unmix_plugin.scenes.reading.entries import FrameEntry, SceneEntry
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.loader import load_scene
from unmix_plugin.scenes.reading.splits import Split, split_frames
from unmix_plugin.settings import SceneOptions


def entry_of(names: list[str], **lists: list[str]) -> SceneEntry:
    frames = tuple(FrameEntry(name, {"file_path": name}) for name in names)
    return SceneEntry(SceneKeys(), None, None, {key: tuple(value) for key, value in lists.items()}, frames)


Method = Literal["auto", "lists", "filename", "interval"]


def split_of(entry: SceneEntry | list[str], method: Method = "auto", interval: int = 8) -> Split:
    faults = Faults(Path("scene"))
    entry = entry if isinstance(entry, SceneEntry) else entry_of(entry)
    split = split_frames(entry, method, interval, faults)
    faults.raise_if_any()
    return split


@pytest.mark.parametrize(
    ("names", "lists", "expected"),
    [
        (["train_0", "train_1", "test_2"], {"train": ["test_2"], "test": ["train_0"]}, Split((2,), (0,))),
        ("abc", {"train": ["a"], "val": ["b"], "test": ["c"]}, Split((0,), (2,))),
        ("abc", {"train": ["a"], "val": ["b"]}, Split((0,), (1,))),
        ("abc", {"train": ["a"], "val": ["b"], "test": []}, Split((0,), (1,))),
        ("abcd", {"train": ["a", "c"]}, Split((0, 2), (1, 3))),  # the others are left
        ("abcd", {"val": ["b"], "test": ["c"]}, Split((0, 3), (2,))),
        (["./x/a", "x/b"], {"train": ["x/a"], "test": ["x/./b"]}, Split((0,), (1,))),
        (["train_0", "val_1", "eval_2", "test_3"], {}, Split((0,), (3,))),
        (["train_0", "val_1", "eval_2"], {}, Split((0,), (1, 2))),
        (["train/r_0.png", "train/r_1.png", "test/r_0.png"], {}, Split((0, 1), (2,))),
        (["images/train_0.png", "images/train_1.png", "images/eval_2.png"], {}, Split((0, 1), (2,))),
        (["images/train-0.png", "images/training1.png", "images/val2.png"], {}, Split((0, 1), (2,))),
        (["a/b/Train/0.png", "a/b/Train/1.png", "a/b/Test/2.png"], {}, Split((0, 1), (2,))),
    ],
)
def test_lists_go_before_names_of_folders_and_files_and_tests_before_validation(names, lists, expected):
    assert split_of(entry_of(list(names), **lists)) == expected


def test_a_picture_that_several_frames_share_lists_all_of_them():
    shared = [{"file_path": f"images/{i // 2}", "hyperspectral_file_path": f"cubes/{i}"} for i in range(6)]
    entry = replace(entry_of([]), frames=tuple(FrameEntry("", paths) for paths in shared))
    for lists, expected in (
        ({"test": ("images/1",)}, Split((0, 1, 4, 5), (2, 3))),
        ({"train": ("images/0", "cubes/4"), "test": ("images/1",)}, Split((0, 1, 4), (2, 3))),
    ):
        assert split_of(replace(entry, split_lists=lists)) == expected


@given(st.lists(st.sampled_from([None, "a", "b", "c", "d", "e"]), min_size=2), st.integers(2, 4))
def test_frames_of_one_shot_are_on_one_side_of_a_split_by_interval(shots, interval):
    entry = entry_of([str(i) for i in range(len(shots))])
    frames = tuple(replace(frame, shot=shot) for frame, shot in zip(entry.frames, shots, strict=True))
    split = split_frames(replace(entry, frames=frames), "interval", interval, Faults(Path("scene")))
    assert sorted(split.train + split.evaluation) == list(range(len(shots)))
    assert not {shots[i] for i in split.train} & {shots[i] for i in split.evaluation} - {None}
    in_order = list(dict.fromkeys(i if shot is None else shot for i, shot in enumerate(shots)))
    assert len({shots[i] or i for i in split.evaluation}) == len(in_order[::interval])


def test_words_that_only_begin_like_a_split_are_no_split():
    with pytest.raises(SceneError, match="neither its folder nor its name starts with"):
        split_of(["images/train_0.png", "images/valley_1.png"], method="filename")
    assert split_of(["trainer_0.png", "testament_1.png"]) == Split((1,), (0,))  # every n-th instead


@given(st.integers(2, 40), st.integers(2, 12))
def test_every_nth_frame_evaluates_and_no_frame_is_lost_or_used_twice(count, interval):
    split = split_of([str(i) for i in range(count)], interval=interval)
    assert sorted(split.train + split.evaluation) == list(range(count))
    assert split.evaluation == tuple(range(0, count, interval))


def test_a_split_that_can_not_be_made_is_refused():
    with pytest.raises(SceneError, match="--eval-split lists needs them"):
        split_of(["a", "b"], "lists")


def test_the_options_choose_the_split_of_a_scene(folder):
    scene = load_scene(folder.root, SceneOptions(eval_split="interval", eval_interval=3))
    assert scene.eval_indices == (0, 3)
    assert scene.train_indices == (1, 2, 4, 5)
