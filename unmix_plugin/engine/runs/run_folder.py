"""The folder of one run: what lies where in it, making and finding one, and letting one training at a time write it."""

import errno
import os
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

from filelock import FileLock, Timeout

from unmix_plugin.engine.runs.atomic_files import safe_name
from unmix_plugin.errors import RunError


@dataclass(frozen=True)
class RunFolder:
    """Where a run keeps its files."""

    path: Path
    """`<output_dir>/<scene>/<method>/<YYYY-MM-DD_HHMMSS>`, absolute."""

    @property
    def config_path(self) -> Path:
        """Every setting of the run."""
        return self.path / "config.json"

    @property
    def scene_path(self) -> Path:
        """What rendering needs of the scene: box, cameras, metadata; and the data manager's summary."""
        return self.path / "scene.json"

    @property
    def training_path(self) -> Path:
        """Steps, seconds and rays of the finished training."""
        return self.path / "training.json"

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def metrics_path(self) -> Path:
        """Losses and metrics, one JSON object a line."""
        return self.path / "metrics.jsonl"

    @property
    def log_path(self) -> Path:
        """Events of the training, one a line."""
        return self.path / "run.log"

    @property
    def eval(self) -> Path:
        """Folder of evaluations."""
        return self.path / "eval"

    @property
    def exports(self) -> Path:
        """Folder of exports."""
        return self.path / "exports"


def create_run_folder(
    output_dir: Path, scene_name: str, method_name: str, started: datetime | None = None
) -> RunFolder:
    """Make a new run folder, named for the local time; a second one in the same second gets `-2` appended. Raises
    RunError: it can't be made."""
    stamp = (started or datetime.now(timezone.utc).astimezone()).strftime("%Y-%m-%d_%H%M%S")
    parent = output_dir.resolve() / safe_name(scene_name, fallback="scene") / safe_name(method_name)
    try:
        parent.mkdir(parents=True, exist_ok=True)
        for number in range(1, 10_000):
            path = parent / (stamp if number == 1 else f"{stamp}-{number}")
            try:
                path.mkdir()
            except FileExistsError:
                continue
            return RunFolder(path)
    except OSError as error:
        raise RunError(
            f"can't make a run folder in {parent}: {error.strerror or error}; choose another --output-dir"
        ) from error
    raise RunError(f"can't make a run folder in {parent}: too many runs called {stamp}")


def open_run_folder(path: Path) -> RunFolder:
    """An existing run folder. Raises RunError: it is missing, is not a run folder, is half-written, or has a link that
    leads out of it."""
    try:
        if not path.is_dir():
            raise RunError(f"no run folder at {path}; give the path that training printed as its last line")
        run = RunFolder(path.resolve())
        # Whoever made the folder must not choose which other files get written. `exports` may be a folder elsewhere, as
        # on a larger disk: no file of others is replaced there.
        is_elsewhere = run.exports.is_symlink() and run.exports.is_dir()
        for top in (run.path, run.exports.resolve()) if is_elsewhere else (run.path,):
            inside = (Path(at, name) for at, folders, files in os.walk(top) for name in (*folders, *files))
            for link in filter(Path.is_symlink, inside):
                if link.resolve().is_relative_to(top) or (is_elsewhere and link == run.exports):
                    continue
                raise RunError(
                    f"{link} is a link that leads out of the run folder, to {link.resolve()}; "
                    "put what it leads to in its place, or remove it"
                )
        missing = [file.name for file in (run.config_path, run.scene_path) if not file.is_file()]
    except (OSError, RuntimeError) as error:  # names too long, links in a circle
        raise RunError(f"can't open the run folder {path}: {error}") from error
    if missing:
        raise RunError(f"{path} is not a run folder, or a half-written one: {' and '.join(missing)} missing")
    return run


def newest_run(output_dir: Path) -> RunFolder:
    """The run under `output_dir` that was started or resumed last, of those that have a checkpoint. Raises RunError:
    there is none."""
    # By time, not by name, which only says what a clock once said.
    found = [
        ((path / "config.json").stat().st_mtime_ns, path)
        for path in output_dir.glob("*/*/*")
        if (path / "config.json").is_file() and checkpoint_steps(path / "checkpoints")
    ]
    if not found:
        raise RunError(
            f"no run with a checkpoint under {output_dir.resolve()}; train one first or name it with --run"
        )
    return open_run_folder(max(found)[1])


def checkpoint_steps(folder: Path) -> list[int]:
    """Steps of the checkpoints in `folder`, newest first, complete or not."""
    stems = (path.stem.removeprefix("step-") for path in folder.glob("step-*.json"))
    return sorted((int(stem) for stem in stems if stem.isascii() and stem.isdigit()), reverse=True)


class RunLock:
    """Held from its making to `release`, or to the end of the process, however it ends."""

    def __init__(self, path: Path, holder: str = "training", wait_s: float = 0.0) -> None:
        """Take the lock, after waiting up to `wait_s` for others to release it. Without a wait the same process may
        take it again. `holder` is what takes such locks. Raises RunError: another one has it, or the file can't be
        made."""
        self._lock = FileLock(path, timeout=wait_s, is_singleton=wait_s == 0, thread_local=False)
        self._is_held = False
        try:
            self._lock.acquire()
            self._is_held = True
        except Timeout as error:
            raise RunError(
                f"another {holder} writes to {path.parent}; stop it first, or wait for its end"
            ) from error
        except NotImplementedError:  # a file system without locks
            return
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):  # the same
                raise RunError(f"can't write {path}: {error.strerror or error}") from error

    def release(self) -> None:
        """Let others train the run. The process may hold the lock more than once, so each gives back its own only."""
        if self._is_held:
            self._is_held = False
            self._lock.release()

    __del__ = release
