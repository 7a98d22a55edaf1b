"""Layout `cubes`: a folder with one spectral file per view, one folder of band files per view, or a tree of such
folders as instruments write them.

Files with the name of a cube and a suffix of a picture are its RGB picture. Where there are pictures alone, they are
the views: three bands, gamma-encoded.

Cameras of Specim write each view with its own references, and what they make of it themselves:

    NAME/capture/{NAME, DARKREF_NAME, WHITEREF_NAME}.{hdr,raw}     stored numbers
    NAME/capture/WHITEDARKREF_NAME.{hdr,raw}                       dark frame of a white that was taken before
    NAME/results/REFLECTANCE_NAME.{hdr,dat}                        taken where a view has no white reference

Cameras of Headwall cut a scan: raw_0, raw_2000 and so on, named by their first line, are joined. Cubert's NAME_cube has
NAME_pan and NAME_view beside it, which show the same; so have others previews. They are left out and named.

The same names count in any folder and in any case; files such as darkReference are references of the views beside them.
"""

from __future__ import annotations

import os
import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from unmix_plugin.captures.cube import Capture, CaptureView, ReadOptions
from unmix_plugin.captures.layouts.masks import MASK_FOLDERS, is_mask_of
from unmix_plugin.captures.names import natural_order, view_names
from unmix_plugin.captures.readers.derived import join_lines
from unmix_plugin.captures.readers.envi import described_image
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.report import Remark
from unmix_plugin.captures.spoilt import UnreadableViews
from unmix_plugin.errors import CaptureError, name_some
from unmix_plugin.formats.envi import header_beside
from unmix_plugin.formats.files import safe_name

_CUBE_SUFFIXES = frozenset(
    {".hdr", ".npy", ".npz", ".tif", ".tiff", ".exr", ".mat", ".h5", ".hdf5", ".he5", ".nc", ".nc4"}
)
_NUMBERS = frozenset(
    {".img", ".dat", ".raw", ".bil", ".bip", ".bsq", ".bin", ".cube", ".hyspex", ".fits", ".zip", ".gz"}
)
"""Of files that may be views whose header is lost, or of a kind that is not read."""
_PICTURE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
_BAND_SUFFIXES = _PICTURE_SUFFIXES | {".tif", ".tiff", ".exr"}
_KIND = r"white[ _-]*dark|white|dark|flat"
_WORD = r"(?:ref(?:erence)?|frame|field|current|calibration)"
_REFERENCE = re.compile(
    rf"(?P<kind>{_KIND})[ _-]*(?P<word>{_WORD})?(?:[ _-]+(?P<of>.+))?"
    rf"|(?P<of2>.+?)[ _-]+(?P<kind2>{_KIND})[ _-]*(?P<word2>{_WORD})?",
    re.IGNORECASE,
)
"""Names of files that hold no view: WHITEREF_212, dark frame 3, 212_darkReference, white."""
_OWN = {
    "dark": ("dark frame of their own", "--dark"),
    "white": ("white reference of their own", "--white"),
    "white_dark": ("dark frame for their white reference alone", "--dark or --white"),
}
"""References of a view, for messages, and what names others."""
_RESULT = re.compile(r"reflectance[ _-]+(?P<of>.+)", re.IGNORECASE)
_RESULTS = "results"
"""Folder of what a camera makes of its numbers."""
_STEPS = ("capture", "captures", "results", "raw")
"""Folders below that of a view, which don't name it."""
_DEEPEST = 5
_PART = re.compile(r"(?P<of>raw)_(?P<line>\d+)(?P<after>(?:_[a-z]+)*)", re.IGNORECASE)
"""A part of a scan by its first line: raw_2000, raw_2000_rd_rf."""
_SHOWN_TOO = re.compile(
    r"(?P<of>.+)[_-](?:pan(?:chromatic)?|view|preview|thumb(?:nail)?|quick[_-]?look|ql|rgb|gr[ae]y)",
    re.IGNORECASE,
)
"""Pictures beside NAME or NAME_cube that show the same."""
_OF_SCENES = ("process.json", "plan.json")
"""In a scene that this command made, or has not finished: its cubes are no views."""


def find_cubes(root: Path, options: ReadOptions) -> Capture:
    """The views of a folder. Raises CaptureError: no file in it can be a view, one can't be opened, two views share a
    name, or the number of wavelengths given is not the number of bands."""
    excluded = {path.resolve() for path in options.exclude}
    files = [path for path in _visible_files(root) if path.resolve() not in excluded]
    plain = {path.stem: path for path in files if path.suffix.lower() in _PICTURE_SUFFIXES}
    cubes = _cubes_among(files)
    if any(not _is_reference(path, ()) for path in cubes):
        return _capture_of_groups(root, {root: cubes}, options)
    # Folders that hold more than one file of a band, and no cube, are views.
    inside = [path for path in root.iterdir() if path.is_dir() and not path.name.startswith(".")]
    inside = [
        path for path in inside if path.name.lower() not in MASK_FOLDERS and path.resolve() not in excluded
    ]
    folders = []
    for path in sorted(path for path in inside if not _is_reference(path, ())):
        suffixes = [file.suffix.lower() for file in _visible_files(path)]
        is_view = sum(suffix in _BAND_SUFFIXES for suffix in suffixes) > 1
        folders += [path] if is_view and not _CUBE_SUFFIXES - _BAND_SUFFIXES & {*suffixes} else []
    if not folders and (deeper := _cubes_below(root, excluded)):  # references may lie in the folder itself
        return _capture_of_groups(root, deeper, options)
    pictures = [*plain.values()]
    shown = folders or [
        path for path in pictures if not _is_reference(path, ()) and not is_mask_of(path, pictures)
    ]
    if not shown:
        kinds = ", ".join(sorted(_CUBE_SUFFIXES | _PICTURE_SUFFIXES))
        raise CaptureError(
            f"{root} holds no cubes; expected one file per view ({kinds}), or one folder of band files per view"
        )
    views, unreadable = _open_views(
        _names(shown), shown, [{}] * len(shown), files if folders else [], options
    )
    return Capture("cubes", root, views, unreadable=unreadable)


def find_lines(root: Path, options: ReadOptions) -> Capture:
    """Layout `lines`: cubes as above, each the scan of a line camera, one row a line. Raises CaptureError: pictures are
    there in place of scans."""
    capture = find_cubes(root, options)
    if pictures := [view.name for view in capture.views if view.cube.is_srgb]:
        raise CaptureError(
            f"{root} holds pictures ({name_some(pictures)}) and no scans; expected cubes, such as ENVI's .hdr"
        )
    return replace(capture, layout="lines")


def _open_views(
    names: Sequence[str],
    paths: Sequence[Path],
    references: Sequence[dict[str, Path]],
    files: Sequence[Path],
    options: ReadOptions,
    joined: Mapping[Path, Sequence[Path]] | None = None,
) -> tuple[tuple[CaptureView, ...], dict[str, Remark]]:
    """Views in the order of their names, each with references of its own by their kind, and the picture among the files
    that lies beside it; and those that can't be opened, with the reason. Raises CaptureError: those are too many.

    Args:
        joined: Parts of a scan by the first of them.
    """
    shown = [path for path in files if path.suffix.lower() in _PICTURE_SUFFIXES]
    pictures, views = {path.with_name(_stem(path)): path for path in shown}, []
    unreadable = UnreadableViews(len(paths))
    for name, path, of_view in zip(names, paths, references, strict=True):
        plain = replace(options, bands=None)
        with unreadable.noted(name):
            opened = {kind: open_spectral_file(reference, plain) for kind, reference in of_view.items()}
            cubes = [open_spectral_file(part, options) for part in (joined or {}).get(path, [path])]
            cube = cubes[0] if len(cubes) == 1 else join_lines(cubes)
            if path.suffix.lower() in _PICTURE_SUFFIXES and cube.dtype.itemsize == 1:
                cube = replace(cube, is_srgb=True)
            view = CaptureView(name, cube, picture=pictures.get(path.with_name(_stem(path))))
            views.append(replace(view, **opened))
    return tuple(sorted(views, key=lambda view: natural_order(view.name))), unreadable.remarks


def _capture_of_groups(root: Path, folders: dict[Path, list[Path]], options: ReadOptions) -> Capture:
    """Views of one folder or of a tree, with the references that were taken for each."""
    groups: dict[tuple[Path, str], dict[str, Path]] = defaultdict(dict)
    left_out: list[Path] = []
    joined: dict[Path, list[Path]] = {}
    shown_too: list[Path] = []
    for folder, there in folders.items():
        # Files whose names are those of pictures of another cube of the folder.
        stems = {_stem(path).casefold() for path in there}
        named = [
            (path, match["of"].casefold()) for path in there if (match := _SHOWN_TOO.fullmatch(_stem(path)))
        ]
        beside = [path for path, of in named if of in stems or {f"{of}_cube", f"{of}-cube"} & stems]
        shown_too += beside
        joined |= (parts := _parts_of_scans([path for path in there if path not in beside]))
        further = {path for scan in parts.values() for path in scan[1:]}
        cubes = [path for path in there if path not in beside and path not in further]
        is_step = folder != root and folder.name.lower() in _STEPS
        place = folder.parent if is_step else folder  # that stands for a view: NAME of NAME/capture
        left_out += _sort_into(groups, place, cubes, is_tree=folder != root)
    complete = {key: group for key, group in groups.items() if "cube" in group or "result" in group}
    if not complete:
        raise CaptureError(
            f"{root} holds references only ({name_some([path.name for path in left_out])}); expected one file per view"
        )
    take_results = all("result" in group for group in complete.values()) and not all(
        "cube" in group and "white" in group for group in complete.values()
    )
    kinds = ["result" if take_results or "cube" not in group else "cube" for group in complete.values()]
    paths = [group[kind] for group, kind in zip(complete.values(), kinds, strict=True)]
    if list(folders) == [root]:
        names = _names(paths)
    else:
        names = view_names(
            [str(place.relative_to(root) / f"{name}.x") for place, name in complete], str(root)
        )
    of_views = [
        {reference: group[reference] for reference in _OWN if reference in group and kind == "cube"}
        for group, kind in zip(complete.values(), kinds, strict=True)
    ]
    there = [path for folder in folders for path in _visible_files(folder)]
    views, unreadable = _open_views(names, paths, of_views, there, options, joined)
    counts = Counter(reference for references in of_views for reference in references)
    notes = [
        f"{counts[kind]} of {len(views)} views have a {what}, which is used{' for all' * (counts[kind] == 1)} unless "
        f"{flag} names another"
        for kind, (what, flag) in _OWN.items()
        if counts[kind]
    ]
    if take_results:
        notes.append("views are the reflectances that the camera wrote, as not all have a white reference")
    if shown_too:
        named = name_some([path.name for path in shown_too])
        notes.append(f"left out, as named like pictures of the cubes beside them: {named}")
    if left_out:
        named = name_some([path.name for path in left_out])
        notes.append(f"left out, as named like references: {named}; use one with --white or --dark")
    lost = [path.name for path in there if path.suffix.lower() in _NUMBERS and header_beside(path) is None]
    warnings = (f"left out, as no header beside them says what they hold: {name_some(lost)}",) if lost else ()
    return Capture("cubes", root, views, notes=tuple(notes), warnings=warnings, unreadable=unreadable)


def _parts_of_scans(cubes: Sequence[Path]) -> dict[Path, list[Path]]:
    """Files of one folder that are parts of a scan, in order, by the first of them: each is named by the line that
    follows the last one before it."""
    series: dict[tuple[str, str], list[tuple[int, Path]]] = defaultdict(list)
    for path in cubes:
        if (match := _PART.fullmatch(_stem(path))) is not None:
            series[match["of"].casefold(), match["after"].casefold()].append((int(match["line"]), path))
    found = {}
    for parts in series.values():
        (line, first), *others = sorted(parts)
        end, parts_in_order = line, [first]
        for line, path in others:
            end += open_spectral_file(parts_in_order[-1]).shape[0]
            if line != end:
                raise CaptureError(
                    f"{first.parent}: {parts_in_order[-1].name} and {path.name} are named like parts of one scan by "
                    f"their first lines, but the second begins at line {line}, and the first ends before {end}; rename "
                    "them"
                )
            parts_in_order.append(path)
        if len(parts_in_order) > 1:
            found[first] = parts_in_order
    return found


def _sort_into(
    groups: dict[tuple[Path, str], dict[str, Path]], place: Path, cubes: list[Path], is_tree: bool
) -> list[Path]:
    """Cubes of one folder by view and by what they are of it: `cube`, `result` (the reflectance that the camera wrote),
    or a kind of reference. Returns references of no view."""
    stems = [_stem(path) for path in cubes]
    references = [path for path in cubes if _is_reference(path, stems)]
    views_here = []
    for path in cubes:
        if path in references:
            continue
        match = _RESULT.fullmatch(_stem(path))
        is_result = match is not None and (path.parent.name.lower() == _RESULTS or match["of"] in stems)
        group = groups[place, match["of"] if is_result and match is not None else _stem(path)]
        other = group.setdefault("result" if is_result else "cube", path)
        if other is not path:
            raise CaptureError(_same_name(other, path))
        views_here += [] if is_result else [_stem(path)]
    left_out = []
    for path in references:
        match = _REFERENCE.fullmatch(_stem(path))
        assert match is not None
        word = (match["kind"] or match["kind2"]).lower()
        kind = "white" if word in ("white", "flat") else "dark" if word == "dark" else "white_dark"
        of = match["of"] or match["of2"]
        owners = [stem for stem in views_here if of is not None and stem.casefold() == of.casefold()]
        if not owners and is_tree and (len(views_here) == 1 or of is None):
            owners = views_here
        for stem in owners:
            groups[place, stem][kind] = path
        left_out += [] if owners else [path]
    return left_out


def _is_reference(path: Path, stems: Sequence[str]) -> bool:
    """Whether a name is that of a reference: with such a word, of a view that is there, or with a number or nothing."""
    match = _REFERENCE.fullmatch(_stem(path))
    if match is None:
        return False
    of = match["of"] or match["of2"]
    if match["word"] or match["word2"] or of is None or (match["of"] or "").isdecimal():
        return True
    return of.casefold() in (stem.casefold() for stem in stems)


def _cubes_among(files: Sequence[Path]) -> list[Path]:
    """Files that may be cubes; a header that describes one of them is none."""
    cubes = [path for path in files if path.suffix.lower() in _CUBE_SUFFIXES]
    return [path for path in cubes if path.suffix.lower() != ".hdr" or described_image(path) is None]


def _cubes_below(root: Path, excluded: set[Path]) -> dict[Path, list[Path]]:
    """Cubes in folders below, by folder."""
    found: dict[Path, list[Path]] = {}
    for parent, folders, _ in os.walk(root):
        folder = Path(parent)
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".")
            and not any((folder / name / record).is_file() for record in _OF_SCENES)
        )
        if len(folder.relative_to(root).parts) == _DEEPEST:
            folders.clear()
        cubes = _cubes_among([path for path in _visible_files(folder) if path.resolve() not in excluded])
        if cubes:
            found[folder] = cubes
    return found


def _names(paths: Sequence[Path]) -> list[str]:
    """Names of views. Raises CaptureError: two have the same."""
    names = [safe_name(_stem(path), fallback="view") for path in paths]
    owners: dict[str, Path] = {}
    for name, path in zip(names, paths, strict=True):
        other = owners.setdefault(name.casefold(), path)
        if other is not path:
            raise CaptureError(_same_name(other, path))
    return names


def _same_name(first: Path, second: Path) -> str:
    name = safe_name(_stem(first), fallback="view")
    return f"{first} and {second} would both be the view '{name}'; rename or move one of them"


def _visible_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))


def _stem(path: Path) -> str:
    """What a view, its references and its picture share: x of x.hdr and x.png, and of x.bil.hdr and x.bil.png."""
    if path.is_dir():
        return path.name
    inner = Path(path.stem)
    is_beside = path.suffix.lower() in {".hdr", *_PICTURE_SUFFIXES} and inner.suffix.lower() in _NUMBERS
    return inner.stem if is_beside else inner.name
