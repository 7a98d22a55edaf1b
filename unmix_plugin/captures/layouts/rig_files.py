"""Which lens and release of the shutter each file of a multispectral camera belongs to."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.captures.camera_tags import XmpTags, tag_text
from unmix_plugin.captures.layouts.found_files import view_names
from unmix_plugin.captures.layouts.frames import Split
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.captures.spectral_file import SpectralFile

BAND_ENDING = re.compile(
    r"(?:_MS)?[_-](\d{1,2}|GRE|GREEN|RED|REG|REDEDGE|RE|NIR|BLUE|RGB|G|R|B|D|W)$", re.IGNORECASE
)
"""Of a file's stem."""
DJI_NUMBER = re.compile(r"(DJI_\d+)(\d)$", re.IGNORECASE)
"""Of a Phantom 4 Multispectral: the last digit is the band, 0 the colour picture."""
EVAL_INTERVAL = 8
"""Every so many releases, one is for evaluation."""
UNIQUE_TAGS = ("MicaSense:CaptureId", "CaptureUUID", "CaptureId")


@dataclass(frozen=True)
class BandFile:
    """One file before it is a view."""

    file: SpectralFile
    base: str
    """Name up to the band, with its folder."""
    ending: str
    """What tells the band in the name."""

    @property
    def tags(self) -> XmpTags:
        return self.file.metadata.get("xmp") or {}


def open_band_file(path: Path, root: Path) -> BandFile:
    file = open_spectral_file(path)
    number = DJI_NUMBER.fullmatch(path.stem)
    found = BAND_ENDING.search(path.stem)
    base, ending = path.stem, ""
    if number is not None:
        base, ending = number[1], number[2]
    elif found is not None:
        base, ending = path.stem[: found.start()], found[1]
    folder = path.parent.relative_to(root)
    return BandFile(file, str(folder / base) if folder.parts else base, ending.lower())


def sensor_names(bands: Sequence[BandFile]) -> list[str]:
    """Names of the lenses: the band's, with the index in the rig where several share it; or the file's ending."""
    titles = [tag_text(item.tags, "BandName") or item.ending or "band" for item in bands]
    slugs = [re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-") or "band" for title in titles]
    indices = [tag_text(item.tags, "RigCameraIndex") or item.ending for item in bands]
    owners: dict[str, set[str]] = defaultdict(set)
    for slug, index in zip(slugs, indices, strict=True):
        owners[slug].add(index)
    return [
        slug if len(owners[slug]) == 1 else f"{slug}-{index or '0'}"
        for slug, index in zip(slugs, indices, strict=True)
    ]


def release_names(bands: Sequence[BandFile], where: str) -> list[str]:
    """Names of the releases: the name up to the band of the first file of each, with its folder where names repeat.

    Identifiers count where they join files; cameras that write another one into every file are grouped by name.

    Raises:
        CaptureError: two releases would have one name.
    """
    identifiers = [tag_text(item.tags, *UNIQUE_TAGS) or "" for item in bands]
    counts = Counter(identifier for identifier in identifiers if identifier)
    keys = [
        identifier if counts[identifier] > 1 else f"name {item.base}"
        for item, identifier in zip(bands, identifiers, strict=True)
    ]
    titles = {key: item.base for key, item in reversed(list(zip(keys, bands, strict=True)))}
    repeated = {title for title, count in Counter(titles.values()).items() if count > 1}
    texts = [f"{title} {key}" if title in repeated else title for key, title in titles.items()]
    names = dict(zip(titles, view_names([f"{text}.tif" for text in texts], where), strict=True))
    return [names[key] for key in keys]


def splits_of(releases: Iterable[str]) -> dict[str, Split]:
    """One of every eight releases is for evaluation, with all its lenses: in their middle, since what the first and
    the last of a flight show no other does."""
    names = sorted(set(releases))
    evaluated = names[min(EVAL_INTERVAL, len(names)) // 2 :: EVAL_INTERVAL]
    return {release: "eval" if release in evaluated else "train" for release in names}
