"""Which camera took which view, by the names of files."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet, name_some
from unmix_plugin.errors import CaptureError, counted

BY_ORDER = "#"
"""Names of cameras whose source gives none begin with it; they are matched in the order of names."""

Keys = Callable[[str], str]


@dataclass(frozen=True)
class Matches:
    """Cameras of the views of a capture."""

    cameras: dict[str, PosedCamera]
    """By the name of the view; views without pose are not in it."""
    unposed: tuple[str, ...]
    """Views for which no camera was found."""
    unused: tuple[str, ...]
    """Cameras that belong to no view."""
    notes: tuple[str, ...]
    """How they were matched and what is odd, one sentence each."""


def match_poses(poses: PoseSet, views: Sequence[tuple[str, Sequence[str | Path]]]) -> Matches:
    """Find the camera of each view.

    Names are compared whole, then as folder and name, file name, and name without suffix, each only where it is unique
    on both sides; if all that finds nothing, by what is left of the names without what they all begin and end with.

    Args:
        views: Name and files of each view; the files as paths, of which the trailing parts count.
    Raises:
        CaptureError: no view has a pose.
    """
    owners = {name: [name, *camera.other_names] for name, camera in poses.cameras.items()}
    wanted = {name: [name, *(str(file) for file in files)] for name, files in views}
    found, how = _by_order(list(owners), list(wanted)), "by their order, as the poses have no names"
    if found is None:
        found, how = _by_names(owners, wanted), "by name"
    if not found:
        found, how = _by_common_part(owners, wanted), "by the part of the names that differs"
    if not found:
        raise CaptureError(
            f"no view has a pose: views are called {name_some(list(wanted)) or '(none)'}, the cameras of "
            f"{poses.source} {name_some(list(owners))}; expected the same names, apart from folders and suffixes: "
            "rename one of them"
        )
    unposed = tuple(name for name in wanted if name not in found)
    unused = tuple(name for name in owners if name not in set(found.values()))
    notes = [f"{len(found)} of {len(wanted)} views were matched {how}"]
    notes += [f"views without pose: {', '.join(unposed)}"] if unposed else []
    notes += [f"{counted(len(unused), 'camera')} without view: {name_some(unused)}"] if unused else []
    cameras = {view: poses.cameras[found[view]] for view in wanted if view in found}
    return Matches(cameras, unposed, unused, (*notes, *_ambiguous(owners, unposed, wanted)))


def _by_order(owners: list[str], wanted: list[str]) -> dict[str, str] | None:
    """Pairs in the order of names, if the cameras have no names; None if they have."""
    if not all(name.startswith(BY_ORDER) for name in owners):
        return None
    if len(owners) != len(wanted):
        raise CaptureError(
            f"there are {len(owners)} poses without names and {len(wanted)} views; expected as many: add or "
            "remove views"
        )
    return dict(zip(sorted(wanted), sorted(owners), strict=True))


def _by_names(owners: dict[str, list[str]], wanted: dict[str, list[str]]) -> dict[str, str]:
    found: dict[str, str] = {}
    for key in (_whole, _folder_and_stem, _file_name, _stem):
        cameras, views = _owners_of(owners, key), _owners_of(wanted, key)
        for view, names in wanted.items():
            hits = (cameras.get(key(name), set()) for name in names if len(views[key(name)]) == 1)
            hit = next((next(iter(those)) for those in hits if len(those) == 1), None)
            if view not in found and hit is not None and hit not in found.values():
                found[view] = hit
    return found


def _by_common_part(owners: dict[str, list[str]], wanted: dict[str, list[str]]) -> dict[str, str]:
    cameras, views = _cores(owners), _cores(wanted)
    return {views[core]: cameras[core] for core in views if core in cameras}


def _cores(names: Iterable[str]) -> dict[str, str]:
    """Names by what differs among them; numbers without leading zeros. Empty if that is not unique."""
    stems = {name: _stem(name) for name in names}
    start = _common_length(list(stems.values()))
    end = _common_length([stem[start:][::-1] for stem in stems.values()])
    cores: dict[str, str] = {}
    for name, stem in stems.items():
        first = start
        while first > 0 and stem[first - 1].isdigit():
            first -= 1
        last = len(stem) - end
        while last < len(stem) and stem[last].isdigit():
            last += 1
        core = stem[first:last]
        cores[str(int(core)) if core.isdecimal() else core] = name
    return cores if len(cores) == len(stems) else {}


def _common_length(texts: list[str]) -> int:
    """Number of characters that all texts begin with."""
    columns = zip(*texts, strict=False)
    return next(
        (index for index, column in enumerate(columns) if len(set(column)) > 1),
        min(map(len, texts), default=0),
    )


def _ambiguous(
    owners: dict[str, list[str]], unposed: Sequence[str], wanted: dict[str, list[str]]
) -> list[str]:
    """A sentence if views have no pose because several views or cameras share a name."""
    cameras, views = _owners_of(owners, _stem), _owners_of(wanted, _stem)
    shared = [
        view
        for view in unposed
        if any(
            cameras.get(_stem(name)) and len(cameras[_stem(name)]) + len(views[_stem(name)]) > 2
            for name in wanted[view]
        )
    ]
    return (
        [f"several views or cameras share the name of {name_some(shared)}; give them names of their own"]
        if shared
        else []
    )


def _owners_of(names: dict[str, list[str]], key: Keys) -> dict[str, set[str]]:
    by_key: dict[str, set[str]] = defaultdict(set)
    for owner, all_names in names.items():
        for name in all_names:
            by_key[key(name)].add(owner)
    return by_key


def _path(name: str) -> PurePosixPath:
    return PurePosixPath(name.replace("\\", "/"))


def _whole(name: str) -> str:
    return str(_path(name))


def _folder_and_stem(name: str) -> str:
    path = _path(name)
    return f"{path.parent.name}/{_stem(name)}"


def _file_name(name: str) -> str:
    return _path(name).name


def _stem(name: str) -> str:
    """File name without its suffix; a dot before digits is not a suffix, as in `view.0001`."""
    path = _path(name)
    return path.name if path.suffix[1:].isdecimal() else path.stem
