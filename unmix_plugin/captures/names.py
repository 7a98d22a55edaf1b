"""Names of files and views: their order, the files that a list names, and which camera took which view."""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath

from unmix_plugin.captures.poses.pose_set import PosedCamera, PoseSet
from unmix_plugin.captures.report import Code, Remark
from unmix_plugin.errors import CaptureError, counted, name_some
from unmix_plugin.formats.files import NOT_PLAIN, safe_name
from unmix_plugin.scenes.reading.faults import find_named


def path_text(text: str) -> str:
    """A path of a JSON file with slashes between folders and without a leading `./`.

    >>> path_text(".\\\\images\\\\0001.png")
    'images/0001.png'
    """
    return text.strip().replace("\\", "/").removeprefix("./")


def size_of_view(name: str, sizes: Mapping[str, tuple[int, int]]) -> tuple[int, int] | None:
    """Width and height of the view that the name of an image means: its own, its file's or the stem's, otherwise those
    that all views have; None where nothing tells.

    Args:
        name: As in `path_text`.
        sizes: By any of these names.
    """
    path, only = PurePosixPath(name), set(sizes.values())
    found = next((sizes[key] for key in (name, path.name, path.stem) if key in sizes), None)
    return only.pop() if found is None and len(only) == 1 else found


def natural_order(name: str) -> list[tuple[int, str]]:
    """A key that sorts numbers in names by their size; no two names have one.

    >>> sorted(["view_10", "view_9"], key=natural_order)
    ['view_9', 'view_10']
    """
    parts = re.split(r"(\d+)", name.lower())
    keys = [(int(part), "") if part.isdecimal() and len(part) < 19 else (-1, part) for part in parts]
    return [*keys, (-2, name)]


def common_length(texts: Sequence[Sequence[str]]) -> int:
    """Number of characters that all texts begin with, or of words of all lists of them."""
    alike = [len(set(column)) == 1 for column in zip(*texts, strict=False)]
    return alike.index(False) if False in alike else len(alike)


def view_names(texts: Sequence[str], where: str) -> list[str]:
    """Names of views from the paths of their files: the stems, or with their folders where stems repeat. Raises
    CaptureError: two paths give the same name."""
    paths = [PurePosixPath(text.replace("\\", "/")) for text in texts]
    stems = [path.name if path.suffix[1:].isdecimal() else path.stem for path in paths]
    if len(set(stems)) < len(stems):
        stems = ["_".join([*path.parent.parts, stem]) for path, stem in zip(paths, stems, strict=True)]
    names = [safe_name(re.sub(NOT_PLAIN, "_", stem).strip("._"), fallback="view") for stem in stems]
    seen: dict[str, str] = {}
    for name, text in zip(names, texts, strict=True):
        other = seen.setdefault(name.casefold(), text)
        if other is not text:
            raise CaptureError(f"{where}: {other} and {text} would both be the view '{name}'; rename one")
    return names


class FoundFiles:
    """Looks for the files of a capture and tells of all that are missing in one message."""

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()
        self._missing: list[str] = []

    def look(self, where: str, *texts: str, least_parts: int = 1) -> Path | None:
        """The first of some paths in the folder that is a file; None if none is. Paths of other systems are followed
        as `find_named` does. CaptureError where a path leaves the folder."""
        for text in texts:
            path = self._root / text
            try:
                is_inside = path.resolve().is_relative_to(self._root) and not Path(text).is_absolute()
                is_file = path.is_file()
            except (OSError, RuntimeError, ValueError) as error:
                raise CaptureError(f"{where}: {text!r} can't be followed ({error})") from error
            if is_inside and is_file:
                return path
            if found := find_named(self._root, text, least_parts):
                return found
            if not is_inside:
                raise CaptureError(f"{where}: {text!r} leaves the folder {self._root}; copy the file into it")
        return None

    def find(self, where: str, text: str, *others: str, least_parts: int = 1) -> Path | None:
        """The same; noted as missing if none is."""
        path = self.look(where, text, *others, least_parts=least_parts)
        self._missing += [] if path else [text]
        return path

    def refuse_missing(self, advice: str) -> None:
        """CaptureError if a file was missing, which names a few of them."""
        if self._missing:
            lacking = f"lacks {counted(len(self._missing), 'file')} of its views"
            raise CaptureError(f"{self._root} {lacking}: {name_some(self._missing)}; {advice}")


# Which camera took which view, by the names of files.

BY_ORDER = "#"
"""Names of cameras whose source gives none begin with it; they belong, in their order, to views in the order of names,
sorted as texts as LLFF does."""


def match_poses(
    poses: PoseSet, views: Sequence[tuple[str, Sequence[str | Path]]]
) -> tuple[dict[str, PosedCamera], list[Remark]]:
    """Find the camera of each view.

    Names are compared whole, then as folder and name, file name, and name without suffix, each only where it is unique
    on both sides; if all that finds nothing, by what is left of the names without what they all begin and end with.

    Args:
        views: Name and files of each view; the files as paths, of which the trailing parts count.
    Returns:
        Cameras by the name of the view, without views that have none; how they were matched, what is odd, and whether
        views may have the poses of others.
    Raises:
        CaptureError: no view has a pose.
    """
    owners = {name: [name, *camera.other_names] for name, camera in poses.cameras.items()}
    wanted = {name: [name, *(str(file) for file in files)] for name, files in views}
    found: dict[str, str] = {}
    is_by_order, how = all(name.startswith(BY_ORDER) for name in owners), "by name"
    if is_by_order and len(owners) != len(wanted):
        raise CaptureError(f"{len(owners)} poses without names and {len(wanted)} views; expected as many")
    if is_by_order:
        found, how = (
            dict(zip(sorted(wanted), owners, strict=True)),
            "by their order, as the poses have no names",
        )
    for key in () if is_by_order else _KEYS:
        cameras, views_of = _owners_of(owners, key), _owners_of(wanted, key)
        for name, those in views_of.items():
            hits = cameras.get(name, set()) - {*found.values()}
            if len(those) == len(cameras.get(name, ())) == len(hits) == 1 and not those & found.keys():
                (view,), (camera,) = those, hits
                found[view] = camera
    if not found:
        cores, named = _cores(owners), _cores(wanted)
        found = {named[core]: cores[core] for core in named if core in cores}
        how = "by the part of the names that differs"
    if not found:
        raise CaptureError(
            f"no view has a pose: views are called {name_some(list(wanted)) or '(none)'}, the cameras of "
            f"{poses.source} {name_some(list(owners))}; expected the same names, apart from folders and suffixes"
        )
    unposed = [name for name in wanted if name not in found]
    used = set(found.values())
    unused = [name for name in owners if name not in used]
    cameras_of, views_of = _owners_of(owners, _stem), _owners_of(wanted, _stem)
    several = {stem for stem in views_of if len(views_of[stem]) + len(cameras_of.get(stem, ())) > 2}
    shared = [view for view in unposed if several & cameras_of.keys() & set(map(_stem, wanted[view]))]
    remarks = [Remark.of(Code.POSES_MATCHED, matched=len(found), views=len(wanted), how=how)]
    if is_by_order and (ordered := sorted(wanted)) != sorted(wanted, key=natural_order):
        remarks.append(Remark.of(Code.NAMES_AS_TEXTS, first=", ".join(ordered[:3])))
    if unposed:
        remarks.append(Remark.of(Code.VIEWS_UNPOSED, names=", ".join(unposed)))
    if unused:
        remarks.append(Remark.of(Code.CAMERAS_UNUSED, cameras=len(unused), names=unused))
    if shared:
        remarks.append(Remark.of(Code.NAMES_SHARED, names=shared))
    of_views, of_cameras = _numbers(wanted), set() if is_by_order else _numbers(owners)
    remarks += [
        Remark.of(Code.NUMBERS_SHIFTED, apart=f"{apart:+d}")
        for apart in (1, -1)
        if of_cameras and {number + apart for number in of_views} == of_cameras
    ]
    return {view: poses.cameras[found[view]] for view in wanted if view in found}, remarks


def _cores(names: Iterable[str]) -> dict[str, str]:
    """Names by what differs among them; numbers without leading zeros. Empty if that is not unique."""
    stems = {name: _stem(name) for name in names}
    start = common_length(list(stems.values()))
    end = common_length([stem[start:][::-1] for stem in stems.values()])
    cores: dict[str, str] = {}
    for name, stem in stems.items():
        # Numbers are taken whole, with the digits that all of them have.
        first = len(stem[:start].rstrip("0123456789"))
        rest = stem[len(stem) - end :]
        last = len(stem) - len(rest.lstrip("0123456789"))
        core = stem[first:last]
        cores[str(int(core)) if core.isdecimal() else core] = name
    return cores if len(cores) == len(stems) else {}


def _numbers(names: Iterable[str]) -> set[int]:
    """What differs among names, if these are numbers."""
    cores = _cores(names)
    return {int(core) for core in cores} if all(core.isdecimal() for core in cores) else set()


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
    return PurePosixPath(unicodedata.normalize("NFC", name.replace("\\", "/")))


_KEYS: tuple[Callable[[str], str], ...] = (
    lambda name: str(_path(name)),
    lambda name: f"{_path(name).parent.name}/{_stem(name)}",
    lambda name: _path(name).name,
    _stem,
)
"""What names are compared by, in turn."""
