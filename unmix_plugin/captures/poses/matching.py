"""Which camera took which view, by the names of files."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path, PurePosixPath

from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet, name_some
from unmix_plugin.errors import CaptureError, counted

BY_ORDER = "#"
"""Names of cameras whose source gives none begin with it; they are matched in the order of names."""


def match_poses(
    poses: PoseSet, views: Sequence[tuple[str, Sequence[str | Path]]]
) -> tuple[dict[str, PosedCamera], list[str]]:
    """Find the camera of each view.

    Names are compared whole, then as folder and name, file name, and name without suffix, each only where it is unique
    on both sides; if all that finds nothing, by what is left of the names without what they all begin and end with.

    Args:
        views: Name and files of each view; the files as paths, of which the trailing parts count.
    Returns:
        Cameras by the name of the view, without views that have none; how they were matched and what is odd, one
        sentence each.
    Raises:
        CaptureError: no view has a pose.
    """
    owners = {name: [name, *camera.other_names] for name, camera in poses.cameras.items()}
    wanted = {name: [name, *(str(file) for file in files)] for name, files in views}
    found, how = _by_order(list(owners), list(wanted)), "by their order, as the poses have no names"
    if found is None:
        found, how = _by_names(owners, wanted), "by name"
    if not found:
        cameras, named = _cores(owners), _cores(wanted)
        found = {named[core]: cameras[core] for core in named if core in cameras}
        how = "by the part of the names that differs"
    if not found:
        raise CaptureError(
            f"no view has a pose: views are called {name_some(list(wanted)) or '(none)'}, the cameras of "
            f"{poses.source} {name_some(list(owners))}; expected the same names, apart from folders and suffixes: "
            "rename one of them"
        )
    unposed = [name for name in wanted if name not in found]
    unused = [name for name in owners if name not in set(found.values())]
    cameras_of, views_of = _owners_of(owners, _stem), _owners_of(wanted, _stem)
    shared = [  # several views or cameras have one name
        view
        for view in unposed
        if any(
            cameras_of.get(_stem(name)) and len(cameras_of[_stem(name)]) + len(views_of[_stem(name)]) > 2
            for name in wanted[view]
        )
    ]
    notes = [f"{len(found)} of {len(wanted)} views were matched {how}"]
    if unposed:
        notes.append(f"views without pose: {', '.join(unposed)}")
    if unused:
        notes.append(f"{counted(len(unused), 'camera')} without view: {name_some(unused)}")
    if shared:
        notes.append(
            f"several views or cameras share the name of {name_some(shared)}; give them names of their own"
        )
    return {view: poses.cameras[found[view]] for view in wanted if view in found}, notes


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
    for key in _KEYS:
        cameras, views = _owners_of(owners, key), _owners_of(wanted, key)
        for view, names in wanted.items():
            hits = (cameras.get(key(name), set()) for name in names if len(views[key(name)]) == 1)
            hit = next((next(iter(those)) for those in hits if len(those) == 1), None)
            if view not in found and hit is not None and hit not in found.values():
                found[view] = hit
    return found


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
    alike = [len(set(column)) == 1 for column in zip(*texts, strict=False)]
    return alike.index(False) if False in alike else len(alike)


def _owners_of(names: dict[str, list[str]], key: Callable[[str], str]) -> dict[str, set[str]]:
    by_key: dict[str, set[str]] = defaultdict(set)
    for owner, all_names in names.items():
        for name in all_names:
            by_key[key(name)].add(owner)
    return by_key


def _stem(name: str) -> str:
    """File name without its suffix; a dot before digits is not a suffix, as in `view.0001`."""
    path = _path(name)
    return path.name if path.suffix[1:].isdecimal() else path.stem


def _path(name: str) -> PurePosixPath:
    return PurePosixPath(name.replace("\\", "/"))


_KEYS: tuple[Callable[[str], str], ...] = (
    lambda name: str(_path(name)),
    lambda name: f"{_path(name).parent.name}/{_stem(name)}",
    lambda name: _path(name).name,
    _stem,
)
"""What names are compared by, in turn."""
