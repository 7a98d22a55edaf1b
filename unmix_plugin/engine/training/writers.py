"""Writing down how training went: metrics as JSON lines (and TensorBoard, where installed), events as a log."""

import importlib.util
import json
import math
import warnings
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from unmix_plugin.engine.runs.atomic_files import write_file
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.errors import RunError

Split = Literal["train", "eval_all"]
"""Which rays a metric is of: a training batch, all evaluation views."""


class MetricsWriter:
    """Appends to `metrics.jsonl` and, if the package is installed, to TensorBoard's files in `tensorboard/`."""

    def __init__(self, run: RunFolder, resumed_step: int = 0) -> None:
        """Go on after step `resumed_step`; what a stopped run wrote beyond it is cut off.

        Raises:
            RunError: the file can't be written.
        """
        self.path = run.metrics_path
        _keep_until(self.path, resumed_step)
        self._board = _tensorboard(run.path / "tensorboard", resumed_step)

    def write(self, step: int, seconds: float, split: Split, values: Mapping[str, float]) -> None:
        """One line; numbers that are not finite become null.

        Raises:
            RunError: the file can't be written.
        """
        finite = {name: value if math.isfinite(value) else None for name, value in values.items()}
        _append(self.path, json.dumps({"step": step, "seconds": round(seconds, 3), "split": split, **finite}))
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(f"{split}/{name}", value, step)

    def write_images(self, step: int, images: Mapping[str, Tensor]) -> None:
        """Pictures (height, width, 3) in [0, 1], for TensorBoard only."""
        if self._board is not None:
            for name, image in images.items():
                self._board.add_image(f"eval/{name}", image.detach().float().cpu(), step, dataformats="HWC")

    def close(self) -> None:
        """Finish TensorBoard's file."""
        if self._board is not None:
            self._board.close()


class RunLog:
    """Appends dated lines to `run.log`."""

    def __init__(self, run: RunFolder) -> None:
        self.path = run.log_path

    def write(self, text: str) -> None:
        """One event.

        Raises:
            RunError: the file can't be written.
        """
        _append(self.path, f"{datetime.now(timezone.utc).isoformat(timespec='seconds')} {text}")


def _append(path: Path, line: str) -> None:
    try:
        with path.open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(line + "\n")
    except OSError as error:
        raise RunError(
            f"can't write {path}: {error.strerror or error}; checkpoints saved before are whole"
        ) from error


def _keep_until(path: Path, step: int) -> None:
    """Rewrite a JSON-lines file without the lines of later steps and without a last line cut off by a kill."""
    if not path.exists():
        return
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    write_file(path, "".join(line + "\n" for line in lines if _is_of_step(line, step)).encode())


def _is_of_step(line: str, step: int) -> bool:
    try:
        return bool(json.loads(line)["step"] <= step)
    except (ValueError, KeyError, TypeError, RecursionError):
        return False


def _tensorboard(folder: Path, resumed_step: int) -> Any | None:
    """TensorBoard's writer; None where the package is not installed."""
    if importlib.util.find_spec("tensorboard") is None:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a third party's deprecations are not our user's concern
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(str(folder), purge_step=resumed_step + 1 if resumed_step else None)
