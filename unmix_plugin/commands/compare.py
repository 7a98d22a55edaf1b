"""`unmix-compare BEFORE AFTER`: what has changed on an object between two captures of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from unmix_plugin.engine.configs import DeviceName
from unmix_plugin.engine.printing import tell
from unmix_plugin.errors import ConfigError, counted

if TYPE_CHECKING:
    from unmix_plugin.comparing.comparison import Comparison


@dataclass(frozen=True)
class CompareOptions:
    """Find what has changed on an object between two runs of it: lay the second on the first, take the light out, and
    write maps, a table of places, a page and a report. Of more runs each is compared with the first."""

    before: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BEFORE")]
    """Run folder of the first capture."""
    after: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="AFTER...")]
    """Run folder of a later capture; several make a series."""
    before_data: Path | None = None
    """Scene folder of the first run, where it is no longer where the run was trained."""
    after_data: tuple[Path, ...] = ()
    """Scene folders of the later runs, one for each, where they are no longer there."""
    scale: Literal["auto", "free", "fixed"] = "auto"
    """Whether a unit of a later world may have any length in the first: free, fixed, or auto, which is fixed where both
    runs have a scale."""
    level: float = 0.05
    """Part of what is said to have changed that may be false."""
    index: tuple[str, ...] = ()
    """Spectral indices to compare too, by name (ndvi) or as a formula."""
    max_views: int = 4
    """Views of the first capture that maps, page and report show."""
    device: DeviceName = "auto"
    """Where to compute; auto takes CUDA where there is one."""
    output: Path | None = None
    """Folder to write to; None: exports/changes in the folder of the last run."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace earlier files."""


def compare(argv: list[str]) -> None:
    """Parse the arguments, compare, say what changed, list the files."""
    options = tyro.cli(CompareOptions, prog="unmix-compare", args=argv)
    if not options.after:
        raise ConfigError("name at least two runs: unmix-compare BEFORE AFTER")
    if options.after_data and len(options.after_data) != len(options.after):
        raise ConfigError(
            f"--after-data names {counted(len(options.after_data), 'scene')} for "
            f"{counted(len(options.after), 'later run')}; give one for each"
        )
    _compare_all(options)


def _compare_all(options: CompareOptions) -> None:
    from functools import partial

    from unmix_plugin.commands.reporting import CommandConsole, follow, working
    from unmix_plugin.comparing import comparison as comparing
    from unmix_plugin.comparing.captured import open_capture
    from unmix_plugin.comparing.files import ChangeFiles, summary_lines
    from unmix_plugin.comparing.series import series_rows
    from unmix_plugin.formats.files import csv_bytes, numbered_apart, refuse_to_overwrite, write_file

    console = CommandConsole()
    folder = (options.output or options.after[-1] / "exports" / "changes").resolve()
    names = numbered_apart(path.resolve().name for path in options.after)
    is_series = len(names) > 1
    folders = [folder / name for name in names] if is_series else [folder]
    files = [ChangeFiles(one, options.max_views, partial(follow, console)) for one in folders]
    series = [folder / "series.csv"] if is_series else []
    refuse_to_overwrite([path for one in files for path in one.paths()] + series, options.overwrite)
    with working(console, f"reading {options.before}"):
        before = open_capture(options.before, options.before_data, options.device, asked_by="--before-data")
    found: list[Comparison] = []
    data = options.after_data or (None,) * len(options.after)
    for path, where, one in zip(options.after, data, files, strict=True):
        with working(console, f"reading {path}"):
            after = open_capture(path, where, options.device, asked_by="--after-data")
        result = comparing.compare(
            before,
            after,
            scale=options.scale,
            level=options.level,
            indices=options.index,
            follow=partial(follow, console),
            working=partial(working, console),
        )
        if is_series:
            tell(f"{path}:")
        for line in summary_lines(result):
            tell(line)
        written = one.write(result)
        tell(f"{one.folder / 'changes.html'}  before and after, what differs, and the places")
        tell(f"{one.folder / 'changes.pdf'}  the same for print")
        tell(f"{one.folder / 'changes.csv'}  the places; {counted(len(written), 'file')} in all")
        found.append(result)
    for path in series:
        write_file(path, csv_bytes(series_rows(found, names)))
        tell(f"{path}  what changed since the first capture, for each region and material")
