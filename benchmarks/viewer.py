"""How fast does the viewer answer, what does it bear, and what does it cost a training?

    python benchmarks/viewer.py
    python benchmarks/viewer.py --run RUN --data SCENE

Serves a run with `unmix-view` and talks to it as pages do, over loopback: a move, a change of layer, eight pages that
move at once. Then trains the same steps with and without the viewer, with nobody, with one page at rest, and with one
that never rests. Without a run it trains one first, for 45 seconds on the built-in scene. Takes about six minutes.
"""

from __future__ import annotations

import contextlib
import io
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import IO, Any

import _common
import _machine
import tyro
from _viewer_training import TrainingSpeed, measure_training

sys.path.insert(0, str(_common.REPOSITORY))  # for the page, which lies with the tests

from tests.factories.viewer_page import Page
from unmix_plugin.engine.configs import DeviceName

FIRST_PICTURE = _common.Limit(150, is_upper=True, unit=" ms")
FULL_PICTURE = _common.Limit(5, aim=2, is_upper=True, unit=" s")
FULL_RATE = _common.Limit(0, aim=30, unit=" pictures/s")
LAYER_SWITCH = _common.Limit(100, is_upper=True, unit=" ms")
MEMORY_GROWTH = _common.Limit(100, is_upper=True, unit=" MB")
SHARES = {
    "no page": _common.Limit(98, unit=" %"),
    "one page at rest": _common.Limit(80, unit=" %"),
    "one page always moving": _common.Limit(50, unit=" %"),
}
SIDE = 512
NUM_PAGES = 8
PAUSE_S = 0.02
"""Between two cameras of a page that moves."""

LAYERS = (
    "false colour",
    "one band",
    "abundance of one endmember",
    "all abundances",
    "segmentation",
    "diffuse part",
)
LAYERS += ("specular part", "principal components", "depth", "opacity", "segmentation confidence", "colour")


@dataclass(frozen=True)
class Options:
    """Answers, load, and what a training loses."""

    run: Path | None = None
    """Run to look at; None trains one on the built-in scene."""
    data: Path = Path("demo")
    """Scene to train on; `demo` is the built-in one."""
    device: DeviceName = "cpu"
    """Where to compute."""
    moves: int = 20
    """Moves whose first picture is timed."""
    load_seconds: float = 60.0
    """How long eight pages move."""
    steps: int = 150
    """Training steps that are timed."""
    rounds: int = 3
    """How often each training is repeated."""
    results: Path | None = None
    """Folder for viewer.json and viewer.md; None: beside the benchmarks."""
    quick: bool = False
    """Few moves, three seconds of load, twenty steps once."""


def main(options: Options) -> None:
    """Measure, judge, publish."""
    machine = _machine.describe_machine(options.device)
    moves, load_s, steps, rounds = options.moves, options.load_seconds, options.steps, options.rounds
    if options.quick:
        moves, load_s, steps, rounds = 3, 3.0, 20, 1
    with tempfile.TemporaryDirectory(prefix="unmix-viewer-") as name:
        folder = Path(name)
        run = options.run or train_run(folder, options, 5 if options.quick else 45)
        with served(run, options.device) as server:
            print("moving and switching layers ...", flush=True)
            answers = measure_answers(server, moves)
            print(f"{NUM_PAGES} pages move for {load_s:g} s ...", flush=True)
            load = measure_load(server, load_s)
        print(f"training {steps} steps {rounds} times, four ways ...", flush=True)
        training = measure_training(folder, options.data, options.device, steps, rounds)
    measured = {
        "answers": answers,
        "load": load,
        "training": training.values,
        "training by processor time": training.processor,
    }
    setting = {
        "run": "45 s on the built-in scene" if options.run is None else f"{run.parent.parent.name}, given",
        "scene of the trainings": options.data.name,
        "canvas": f"{SIDE} x {SIDE}",
        "moves": moves,
        "pages under load": NUM_PAGES,
        "steps, rounds": f"{steps}, {rounds}",
        "device": options.device,
        "viewer's share while training": training.share,
    }
    figures = judge(answers, load, training, options.device)
    question = "The viewer's answers, what it bears, and what it costs a training"
    report = _common.Report("viewer", question, setting, machine, figures, measured)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def judge(
    answers: dict[str, Any], load: dict[str, Any], training: TrainingSpeed, device: str
) -> list[_common.Figure]:
    """The lines of the table."""
    answered = f"{min(load['pictures'])} to {max(load['pictures'])} pictures a page"
    figures = [
        FIRST_PICTURE.judge("first picture after a move, median", median(answers["first_ms"])),
        _common.reported("first picture after a move, slowest", f"{max(answers['first_ms']):.0f} ms"),
        _common.reported("size of first pictures", f"{answers['first_rows']} rows of {SIDE}"),
        FULL_PICTURE.judge(f"full {SIDE} x {SIDE} colour after a move, median", median(answers["full_s"])),
        LAYER_SWITCH.judge(
            "change of layer at rest, slowest of all layers", max(answers["layers_ms"].values())
        ),
        LAYER_SWITCH.judge(
            "the same with objects to hide, hence depth", max(answers["layers_with_depth_ms"].values())
        ),
        _common.required(
            f"{NUM_PAGES} pages moving at once", "all served", min(load["pictures"]) > 0, answered
        ),
        _common.required("errors under load", "none", not load["errors"], str(len(load["errors"]))),
        MEMORY_GROWTH.judge("growth of memory under load", load["growth_mb"]),
    ]
    if device == "cuda":
        figures.insert(
            4, FULL_RATE.judge("full pictures a second while moving", 1 / median(answers["full_s"]))
        )
    figures += [
        limit.judge(f"training speed with the viewer, {name}", 100 * training.relative(name))
        for name, limit in SHARES.items()
    ]
    undisturbed = 100 * training.relative_by_processor("no page")
    return [*figures, SHARES["no page"].judge("the same by processor time, no page", undisturbed)]


@dataclass(frozen=True)
class Server:
    """A viewer in a process of its own."""

    address: str
    process: subprocess.Popen[bytes]
    log: IO[bytes]

    @property
    def memory_mb(self) -> float:
        """Resident size."""
        found = subprocess.run(
            ["ps", "-o", "rss=", "-p", str(self.process.pid)], capture_output=True, check=True
        )
        return int(found.stdout) * 1024 / 1e6

    def errors(self) -> list[str]:
        """Lines of its output that tell of a failure."""
        self.log.seek(0)
        lines = self.log.read().decode(errors="replace").splitlines()
        return [line for line in lines if re.search(r"Traceback|Error|warning", line)]


@contextlib.contextmanager
def served(run: Path, device: str) -> Iterator[Server]:
    """`unmix-view` on any free port."""
    words = [
        _common.console_script("unmix-view"),
        "--run",
        str(run),
        "--device",
        device,
        "--viewer.port",
        "0",
    ]
    with tempfile.TemporaryFile() as log:
        process = _common.start(words, log)
        try:
            yield Server(address_in(log, process), process, log)
        finally:
            process.terminate()
            process.wait(30)


def address_in(log: IO[bytes], process: subprocess.Popen[bytes]) -> str:
    """The websocket's address, once the command has printed it."""
    for _ in range(1200):
        log.seek(0)
        output = log.read().decode(errors="replace")
        found = re.search(r"viewer: http://(\S+)", output)
        if found:
            return f"ws://{found[1]}"
        if process.poll() is not None:
            raise SystemExit(f"unmix-view ended:\n{output}")
        time.sleep(0.1)
    raise SystemExit("unmix-view did not start in two minutes")


def measure_answers(server: Server, moves: int) -> dict[str, Any]:
    """Milliseconds to first pictures and layers, seconds to full ones, of one page."""
    with Page(server.address, width=SIDE, height=SIDE) as page:
        page.look_from(0.0)
        page.wait_until(lambda: rows_of(page) == SIDE, 120)
        first, full, rows = [], [], []
        for move in range(moves):
            sent, count = time.monotonic(), len(page.pictures)
            page.look_from(0.3 * (move + 1))
            page.wait_until(lambda count=count: len(page.pictures) > count)
            first.append(1000 * (page.pictures[count][0] - sent))
            rows.append(rows_of(page))
            page.wait_until(lambda: rows_of(page) == SIDE, 120)
            full.append(page.pictures[-1][0] - sent)
        layers = measure_layers(page)
        page.set("scene box", True)
        page.wait_until(lambda: page.last_depth is not None)
        with_depth = measure_layers(page)
    return {
        "first_ms": first,
        "first_rows": int(median(rows)),
        "full_s": full,
        "layers_ms": layers,
        "layers_with_depth_ms": with_depth,
    }


def measure_layers(page: Page) -> dict[str, float]:
    """Milliseconds from the choice of a layer to its picture, at rest; after each layer was shown once."""
    found: dict[str, float] = {}
    for _ in range(2):
        for layer in LAYERS:
            time.sleep(0.1)
            sent, count = time.monotonic(), len(page.pictures)
            page.set("layer", layer)
            page.wait_until(lambda count=count: len(page.pictures) > count)
            found[layer] = 1000 * (page.pictures[count][0] - sent)
    return found


def rows_of(page: Page) -> int:
    """Height of the newest picture."""
    from PIL import Image

    return Image.open(io.BytesIO(page.last_picture)).size[1] if page.last_picture else 0


def measure_load(server: Server, seconds: float) -> dict[str, Any]:
    """Pages that all move at once: pictures of each, growth of the server's memory, errors in its output."""
    with contextlib.ExitStack() as stack:
        pages = [stack.enter_context(Page(server.address)) for _ in range(NUM_PAGES)]
        stop = threading.Event()
        movers = [
            threading.Thread(target=keep_moving, args=(page, index, stop)) for index, page in enumerate(pages)
        ]
        for mover in movers:
            mover.start()
        time.sleep(min(10.0, seconds))  # what every page takes once is not growth
        before, counts = server.memory_mb, [len(page.pictures) for page in pages]
        time.sleep(seconds)
        after = server.memory_mb
        pictures = [len(page.pictures) - count for page, count in zip(pages, counts, strict=True)]
        stop.set()
        for mover in movers:
            mover.join()
    return {"pictures": pictures, "growth_mb": after - before, "memory_mb": after, "errors": server.errors()}


def keep_moving(page: Page, index: int, stop: threading.Event) -> None:
    """Fly a page around the scene."""
    step = 0
    while not stop.wait(PAUSE_S):
        step += 1
        page.look_from(0.02 * step + index)


def train_run(folder: Path, options: Options, seconds: float) -> Path:
    """A run to look at."""
    words = [_common.console_script("unmix-train"), "unmix-nerf", "--data", str(options.data)]
    words += ["--output-dir", str(folder), "--max-seconds", str(seconds), "--device", options.device]
    return _common.run_command([*words, "--pipeline.model.num-endmembers", "6"]).run


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
