"""The views of a run: names and cameras, from the run folder alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from unmix_plugin.engine.runs.load_run import SceneRecord

ViewChoice = Literal["eval", "train", "all"]
"""Evaluation views, training views, or the ones and then the others."""


@dataclass(frozen=True)
class RunView:
    """One view of the scene that a run was trained on."""

    name: str
    """Unique in the scene, fit for file names."""
    camera: Cameras
    """One camera, model space."""


def views_of(scene: SceneRecord, choice: ViewChoice) -> list[RunView]:
    """The views chosen, named as the scene's frames are."""
    splits = {"eval": scene.eval_cameras, "train": scene.train_cameras}
    chosen = splits if choice == "all" else {choice: splits[choice]}
    return [
        RunView(name, cameras[index])
        for split, cameras in chosen.items()
        for index, name in enumerate(_names(scene, split, len(cameras)))
    ]


def find_view(numbered: Sequence[RunView], wanted: str, others: Sequence[RunView] = ()) -> RunView:
    """A view by its name, or by its number from 0.

    Args:
        numbered: The views that numbers count.
        wanted: Name or number; a name goes first.
        others: Views that can be had by name only.
    Raises:
        ConfigError: there is none.
    """
    by_name = {view.name: view for view in (*others, *numbered)}
    if wanted in by_name:
        return by_name[wanted]
    if wanted.isdecimal() and int(wanted) < len(numbered):
        return numbered[int(wanted)]
    hint = did_you_mean(wanted, list(by_name), likeness=0.4, form=" ({})")
    raise ConfigError(
        f"no view {wanted!r}{hint}; give a number from 0 to {len(numbered) - 1}, or a name such as {numbered[0].name}"
    )


def _names(scene: SceneRecord, split: str, count: int) -> list[str]:
    """Frame names, or `eval_000` where the data manager has noted none."""
    frames, indices = scene.summary.get("frames"), scene.summary.get(f"{split}_indices")
    if isinstance(frames, list) and isinstance(indices, list) and len(indices) == count:
        return [str(frames[index]) for index in indices]
    return [f"{split}_{index:03d}" for index in range(count)]
