"""Which frames train and which evaluate: by lists, by folder or file name, or every n-th shot.

Evaluation frames are those of the test split if there are any, otherwise those of the validation split.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Literal

from unmix_plugin.scenes.folder import CUBE_KEY
from unmix_plugin.scenes.messages import Message
from unmix_plugin.scenes.reading.entries import SceneEntry
from unmix_plugin.scenes.reading.faults import FILE_NAME, Faults

_SPLIT_NAMES = ("train", "eval", "val", "test")
_SPLIT_NAME = re.compile(
    r"(train(?:ing)?|eval(?:uation)?|val(?:idation)?|test(?:ing)?)(?![a-z])", re.IGNORECASE
)
"""A folder or file name that starts with a split's name as a word of its own: train_000, test, val-3, eval7."""


@dataclass(frozen=True)
class Split:
    """Indices of frames, increasing."""

    train: tuple[int, ...]
    evaluation: tuple[int, ...]


def split_frames(
    entry: SceneEntry, method: Literal["auto", "lists", "filename", "interval"], interval: int, faults: Faults
) -> Split:
    """Split the frames; notes a fault where training or evaluation has no frame."""
    if method == "lists" and not entry.split_lists:
        faults.note(FILE_NAME, Message.NO_SPLIT_LISTS)
        return Split((), ())
    words = [_name_split(frame.paths) for frame in entry.frames]
    if method == "lists" or (method == "auto" and entry.split_lists):
        names = [
            [frame.paths[key] for key in (CUBE_KEY, "file_path") if key in frame.paths]
            for frame in entry.frames
        ]
        train, evaluation = split_by_lists(names, entry.split_lists, faults)
        for index in sorted(train & evaluation):
            faults.note(entry.frames[index].where, Message.IN_BOTH_SPLITS)
        split = Split(tuple(sorted(train)), tuple(sorted(evaluation)))
    elif method == "filename" or (method == "auto" and None not in words and {"train"} < set(words)):
        members: dict[str | None, list[int]] = {}
        for index, (frame, word) in enumerate(zip(entry.frames, words, strict=True)):
            members.setdefault(word, []).append(index)
            if word is None:
                faults.note(frame.where, Message.NO_SPLIT_NAME)
        validation = sorted(members.get("eval", []) + members.get("val", []))
        split = Split(tuple(members.get("train", [])), tuple(members.get("test") or validation))
    else:
        # Every n-th shot evaluates; the frames that a rig took together stay together, they show the same.
        numbers: dict[str | int, int] = {}
        shots = [
            numbers.setdefault(index if frame.shot is None else frame.shot, len(numbers))
            for index, frame in enumerate(entry.frames)
        ]
        is_evaluated = [shot % interval == 0 for shot in shots]
        train, evaluation = (
            tuple(index for index, one in enumerate(is_evaluated) if one == chosen)
            for chosen in (False, True)
        )
        split = Split(train, evaluation)
    how = "split chosen by itself" if method == "auto" else f"split by {method}"
    if entry.frames and not split.train:
        faults.note(FILE_NAME, Message.NONE_TO_TRAIN, how=how)
    if entry.frames and not split.evaluation:
        faults.note(FILE_NAME, Message.NONE_TO_EVALUATE, how=how)
    return split


def split_by_lists(
    names: Sequence[Iterable[str]], lists: Mapping[str, Sequence[str]], faults: Faults
) -> tuple[set[int], set[int]]:
    """Indices of frames that train and that evaluate.

    Args:
        names: Paths that each frame is called by.
        lists: Those of `train`, `val` and `test`, where there are some; a fault is noted where no frame has one.
    """
    owners: dict[str, set[int]] = {}  # several frames may share a picture, such as those of a rig's cubes
    for index, paths in enumerate(names):
        for path in paths:
            owners.setdefault(str(PurePosixPath(path)), set()).add(index)
    chosen: dict[str, set[int]] = {}
    for name, paths in lists.items():
        chosen[name] = set()
        for path in paths:
            named = owners.get(str(PurePosixPath(path)), set())
            if not named:
                faults.note(f"'{name}_filenames'", Message.NOT_A_FRAME, path=path)
            chosen[name] |= named
    everything = set(range(len(names)))
    train = chosen.get("train", everything - chosen.get("val", set()) - chosen.get("test", set()))
    evaluation = chosen.get("test") or chosen.get("val")
    if evaluation is None:
        evaluation = everything - chosen["train"] if "train" in chosen else set()
    return train, evaluation


def _name_split(paths: dict[str, str]) -> str | None:
    """The split that the parent folder or the name of a frame's picture or cube starts with."""
    for key in ("file_path", CUBE_KEY):
        path = PurePosixPath(paths.get(key, ""))
        for word in (path.name, path.parent.name):
            if match := _SPLIT_NAME.match(word):
                return next(name for name in _SPLIT_NAMES if match.group(1).lower().startswith(name))
    return None
