"""What every benchmark needs: verdicts on figures, results as JSON and as a table, commands.

A benchmark is one command without obligatory arguments. It prints a table and writes `results/NAME.json` and
`results/NAME.md`; a figure that is missed is a result like any other, so the exit code is 0. A `--quick` run shows that
the benchmark works: its figures mean nothing, and it writes only where `--results` says.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, TypeAlias

from rich.console import Console
from rich.table import Table

import unmix_plugin.commands  # noqa: F401 - settles how threads wait, which must be before torch is imported

if TYPE_CHECKING:
    from unmix_plugin.engine.training.trainer import Trainer

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.append(str(REPOSITORY))  # tools/ is in no wheel
RESULTS = Path(__file__).resolve().parent / "results"

MADE = ".made"
"""A file that says that a scene of the cache is whole."""
UNSEEN = tuple(f"unseen-{number}" for number in range(1, 7))
"""Drawn scenes: nobody chooses settings by looking at them."""
SCENES = ("table", "room", "pots", "turntable", "outdoors", *UNSEEN)
"""Scenes of `scenes.py` that can be trained on as they are."""

Verdict: TypeAlias = Literal["aim reached", "pass", "MISS", "not measured", "reported"]


@dataclass(frozen=True)
class Figure:
    """One line of a benchmark's table."""

    what: str
    asked: str
    reached: str
    verdict: Verdict


@dataclass(frozen=True)
class Limit:
    """What a number has to keep to."""

    required: float
    aim: float | None = None
    is_upper: bool = False
    """Whether smaller is better."""
    unit: str = ""

    def judge(self, what: str, value: float | None) -> Figure:
        """The line of `value`; None is a number that was not measured."""
        asked = f"{'at most' if self.is_upper else 'at least'} {self._with_unit(self.required)}"
        if self.aim is not None:
            asked += f"; aim {self._with_unit(self.aim)}"
        if value is None:
            return Figure(what, asked, "", "not measured")
        return Figure(what, asked, self._with_unit(value), self._verdict(value))

    def _verdict(self, value: float) -> Verdict:
        if not self._keeps(value, self.required):
            return "MISS"
        return "aim reached" if self.aim is not None and self._keeps(value, self.aim) else "pass"

    def _keeps(self, value: float, bound: float) -> bool:
        return value <= bound if self.is_upper else value >= bound

    def _with_unit(self, value: float) -> str:
        return f"{value:.4g}{self.unit}"


def reported(what: str, reached: str) -> Figure:
    """A line of which nothing is asked; without text it was not measured."""
    return Figure(what, "", reached, "reported" if reached else "not measured")


def required(what: str, asked: str, holds: bool, reached: str) -> Figure:
    """A line of something that holds or does not."""
    return Figure(what, asked, reached, "pass" if holds else "MISS")


@dataclass(frozen=True)
class DetailTable:
    """A further table, with details."""

    title: str
    headers: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Report:
    """All that a benchmark found."""

    name: str
    question: str
    setting: Mapping[str, Any]
    """What was run, in JSON's types; no paths."""
    machine: Mapping[str, Any]
    figures: Sequence[Figure]
    measured: Any
    """Every number behind the figures, in JSON's types."""
    tables: Sequence[DetailTable] = field(default=())
    variant: str = ""
    """What tells its files from others that the same benchmark writes."""

    @property
    def file_name(self) -> str:
        """Of what is written, without the ending."""
        return results_name(self.name, self.variant)


def results_name(name: str, variant: str) -> str:
    """What a variant's files are called, without the ending."""
    return f"{name}-{variant}" if variant else name


def seconds_variant(max_seconds: float | None) -> str:
    """Variant of a benchmark whose trainings end after so many seconds.

    >>> seconds_variant(90.0)
    '90s'
    """
    return "" if max_seconds is None else f"{max_seconds:g}s"


def publish(report: Report, results: Path | None) -> None:
    """Print the table, and write JSON and Markdown into the folder `results`, if there is one."""
    console = Console()
    console.print(_rich_table(report.question, _FIGURE_HEADERS, _figure_rows(report)))
    for table in report.tables:
        console.print(_rich_table(table.title, table.headers, table.rows))
    if results is None:
        return
    results.mkdir(parents=True, exist_ok=True)
    values = asdict(report)
    (results / f"{report.file_name}.json").write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    (results / f"{report.file_name}.md").write_text(_markdown(report), encoding="utf-8")
    print(f"written: {results / report.file_name}.json and .md")


def results_folder(given: Path | None, quick: bool) -> Path | None:
    """Where to write: the given folder, or `results/` beside the benchmarks; nowhere after a quick run."""
    return given if given is not None else None if quick else RESULTS


def scenes_folder() -> Path:
    """Where the path-traced scenes are kept: $UNMIX_BENCHMARK_SCENES, or a folder of the user's cache."""
    from unmix_plugin.scenes.demo.scene import user_cache

    given = os.environ.get("UNMIX_BENCHMARK_SCENES")
    return Path(given) if given else user_cache() / "benchmark-scenes"


def cached_scene(name: str) -> Path:
    """Folder of a scene of `scenes.py`, which may not be there yet."""
    return scenes_folder() / name


def scene_folders(scenes: Path | None, only: Sequence[str]) -> list[Path]:
    """Folders of the scenes below a folder, or of those of `scenes.py` if None is given.

    Args:
        scenes: Folder of scene folders.
        only: Names of the scenes that are wanted; all if there are none.

    Raises:
        SystemExit: there is none, or one that is wanted is missing; with status 2.
    """
    if scenes is None:
        names = [name for name in SCENES if name in only] if only else SCENES
        folders = [cached_scene(name) for name in [*names, *(name for name in only if name not in SCENES)]]
    elif only:
        folders = [scenes / name for name in only]
    else:
        found = sorted(path.parent for path in scenes.glob("*/transforms.json"))
        folders = [path for path in found if path.suffix != ".building"]
        if not folders:
            require_data(scenes / "*/transforms.json", "any scene")
    require_scenes(*folders)
    return folders


def require_scenes(*folders: Path) -> None:
    """End with status 2 where scenes are missing, and say which command makes them."""
    missing = [folder for folder in folders if not (folder / "transforms.json").is_file()]
    if not missing:
        return
    wanted = " ".join(folder.name for folder in missing if folder == cached_scene(folder.name))
    remedy = f"make it: python benchmarks/scenes.py --only {wanted}" if wanted else ""
    require_data(missing[0] / "transforms.json", f"the scene {missing[0].name}", remedy)


def is_made(folder: Path) -> bool:
    """Whether `scenes.py` has written all of a scene."""
    return (folder / MADE).is_file()


def require_data(data: Path, what: str, remedy: str = "") -> None:
    """End with status 2 where the data of a benchmark are missing, and say which command makes them.

    Args:
        data: A file or folder that has to be there.
        what: What it is.
        remedy: How to get it; if not given, how to render scenes.
    """
    if data.exists():
        return
    made = (
        f"python benchmarks/scenes.py renders scenes into {scenes_folder()}, where benchmarks look for them"
    )
    print(f"{what} is missing: {data}. {remedy or made}", file=sys.stderr)
    raise SystemExit(2)


@dataclass(frozen=True)
class Ended:
    """A command that has ended."""

    status: int
    """Exit code; minus the signal's number if it was killed."""
    output: str
    """Standard output and standard error."""
    seconds: float
    peak_bytes: int
    """Largest resident size. Linux counts what this process had at the start of the child, so it can be too large."""
    cpu_seconds: float = 0.0
    """Processor time of the command and of all that it waited for."""

    @property
    def run(self) -> Path:
        """The run folder that training printed at its end."""
        named = [line.removeprefix("run: ") for line in self.output.splitlines() if line.startswith("run: ")]
        return Path(named[-1])


def console_script(name: str) -> str:
    """Path of an installed command of ours."""
    path = Path(sysconfig.get_path("scripts")) / name
    if not path.exists():
        raise SystemExit(
            f"{name} is not installed beside this Python; run make test once, or pip install -e ."
        )
    return str(path)


def start(
    words: Sequence[str], output: IO[bytes], cwd: Path | None = None, env: Mapping[str, str] | None = None
) -> subprocess.Popen[bytes]:
    """Start a command whose standard output and standard error go to the file `output`."""
    return subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, cwd=cwd, env=env
    )


def run_command(
    words: Sequence[str],
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    must_succeed: bool = True,
) -> Ended:
    """Run a command to its end.

    Raises:
        SystemExit: it failed but must not; the message has the end of its output.
    """
    with tempfile.TemporaryFile() as log:
        started = time.perf_counter()
        process = start(words, log, cwd, env)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        seconds = time.perf_counter() - started
        log.seek(0)
        output = log.read().decode(errors="replace")
    if must_succeed and process.returncode != 0:
        tail = "\n".join(output.splitlines()[-20:])
        raise SystemExit(f"{Path(words[0]).name} ended with {process.returncode}:\n{tail}")
    # macOS gives bytes, Linux units of 1024.
    unit = 1 if platform.system() == "Darwin" else 1024
    cpu_seconds = usage.ru_utime + usage.ru_stime
    return Ended(process.returncode, output, seconds, usage.ru_maxrss * unit, cpu_seconds)


def quiet_trainer(words: Sequence[str]) -> Trainer:
    """What `unmix-train` with these words would train, without its display."""
    from unmix_plugin.commands.train import parse
    from unmix_plugin.engine.training.trainer import Trainer

    with open(os.devnull, "w") as nowhere:  # noqa: PTH123 - a device, not a path
        return Trainer(parse(list(words))[0], console=Console(file=nowhere, quiet=True))


def take_steps(trainer: Trainer, numbers: Iterable[int], total: int) -> int:
    """Take these of `total` steps as a training does, parameters averaged; their rays. Step 0 starts a training."""
    rays = 0
    for step in numbers:
        if step == 0:
            trainer.pipeline.model.warm_up()
            trainer.steps.begin(0)
        rays += trainer.steps.take(step, step / total).num_rays
        if trainer.average is not None:
            trainer.average.update(step + 1)
    return rays


def averaged(trainer: Trainer) -> AbstractContextManager[None]:
    """The trainer's model with its parameters averaged over steps, where the method averages them."""
    return nullcontext() if trainer.average is None else trainer.average.swapped_in()


def evaluated_psnr(trainer: Trainer) -> float:
    """Mean PSNR of the evaluation views, dB."""
    with averaged(trainer):
        return trainer.pipeline.get_average_eval_image_metrics_and_images()[0]["psnr"]


def json_lines(path: Path) -> list[dict[str, Any]]:
    """The whole lines of a JSON-lines file that may still be written to; none if it is not there yet."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


_FIGURE_HEADERS = ("what", "asked", "reached", "verdict")


def _figure_rows(report: Report) -> list[tuple[str, ...]]:
    return [(figure.what, figure.asked, figure.reached, figure.verdict) for figure in report.figures]


def _rich_table(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table(*headers, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    return table


def _markdown(report: Report) -> str:
    lines = [
        f"# {report.file_name}",
        "",
        report.question,
        "",
        *_markdown_table(_FIGURE_HEADERS, _figure_rows(report)),
    ]
    for table in report.tables:
        lines += ["", f"## {table.title}", "", *_markdown_table(table.headers, table.rows)]
    lines += ["", "## Setting", "", *_list(report.setting)]
    lines += ["", "## Machine", "", *_list(report.machine)]
    return "\n".join([*lines, "", f"Made by `python benchmarks/{report.name}.py`.", ""])


def _list(values: Mapping[str, Any], indent: str = "") -> list[str]:
    """Names and values as a list, those of a mapping as a list below its name.

    >>> _list({"steps": (500, 800), "words": {"plain": ""}})
    ['- steps: 500, 800', '- words:', '  - plain: none']
    """
    lines = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            lines += [f"{indent}- {key}:", *_list(value, indent + "  ")]
        else:
            shown = value if isinstance(value, Sequence) and not isinstance(value, str) else [value]
            lines.append(f"{indent}- {key}: {', '.join(map(_readable, shown)) or 'none'}")
    return lines


def _readable(value: Any) -> str:
    if value is None or value == "":
        return "none"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _markdown_table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    cells = [headers, ["---"] * len(headers), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in cells]
