"""Checkpoints: tensors as safetensors beside a JSON record with their hash.

`step-NNNNNN.json` is written last, so a checkpoint exists if and only if its record does; and it counts as complete
only if the tensors' SHA-256 is the record's.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from unmix_plugin.engine.runs.atomic_files import remove_stale_temporaries, write_file
from unmix_plugin.engine.runs.run_files import OtherFormatError, read_run_json, write_run_json
from unmix_plugin.errors import RunError


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint holds."""

    step: int
    """Training steps done."""
    tensors: dict[str, Tensor]
    """Tensors on the CPU."""
    record: dict[str, Any]
    """What was saved beside them, and `format_version`, `step`, `sha256`."""
    damaged: tuple[str, ...] = ()
    """Newer checkpoints that were passed over, each with the reason."""


def save_checkpoint(
    folder: Path, step: int, tensors: Mapping[str, Tensor], record: Mapping[str, Any], keep: int = 2
) -> Path:
    """Save a checkpoint, then remove all but it and the `keep - 1` complete ones before it.

    Args:
        folder: Made if missing.
        step: Training steps done, >= 0.
        tensors: What to save, on any device.
        record: What to save as JSON.
        keep: How many checkpoints stay, >= 1.
    Returns:
        The path of the record.
    Raises:
        RunError: the disk is full or refuses; the checkpoints from before are as they were.
    """
    data = safetensors.torch.save(_separate(tensors))
    tensors_path, record_path = folder / f"{_stem(step)}.safetensors", folder / f"{_stem(step)}.json"
    sha256 = hashlib.sha256(data).hexdigest()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_stale_temporaries(folder)
        _remove_orphans(folder)
        if not _has_tensors(record_path, sha256):
            record_path.unlink(missing_ok=True)
            write_file(tensors_path, data)
        write_run_json(record_path, {**record, "step": step, "sha256": sha256})
        _remove_others(folder, step, keep)
    except OSError as error:
        raise RunError(f"can't write to {folder}: {error.strerror or error}") from error
    except RunError:
        _remove_orphans(folder)
        raise
    return record_path


def newest_complete_checkpoint(folder: Path) -> Checkpoint | None:
    """The newest checkpoint whose tensors have the hash that its record says; None if there is none.

    Raises:
        OtherFormatError: another version of this package wrote a record.
    """
    damaged: list[str] = []
    for step in checkpoint_steps(folder):
        found = _read(folder / f"{_stem(step)}.json")
        if not isinstance(found, str):
            return Checkpoint(step, *found, tuple(damaged))
        damaged.append(f"{_stem(step)}: {found}")
    return None


def _read(record_path: Path) -> tuple[dict[str, Tensor], dict[str, Any]] | str:
    """Tensors and record of a checkpoint, or what is wrong with it."""
    try:
        record = read_run_json(record_path)
        data = record_path.with_suffix(".safetensors").read_bytes()
        if hashlib.sha256(data).hexdigest() != record.get("sha256"):
            return "the tensors do not have the hash of the record"
        return safetensors.torch.load(data), record
    except OtherFormatError:
        raise
    except (OSError, RunError, SafetensorError, ValueError, KeyError) as error:
        return str(error)


def checkpoint_steps(folder: Path) -> list[int]:
    """Steps of the checkpoints in `folder`, newest first, complete or not."""
    stems = (path.stem.removeprefix("step-") for path in folder.glob("step-*.json"))
    return sorted((int(stem) for stem in stems if stem.isdigit()), reverse=True)


def _stem(step: int) -> str:
    return f"step-{step:06d}"


def _separate(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Contiguous tensors on the CPU that share no memory, as safetensors wants them."""
    separate: dict[str, Tensor] = {}
    seen: set[int] = set()
    for name, tensor in tensors.items():
        copy = tensor.detach().cpu().contiguous()
        storage = copy.untyped_storage().data_ptr()
        separate[name] = copy.clone() if storage in seen else copy
        seen.add(storage)
    return separate


def _has_tensors(record_path: Path, sha256: str) -> bool:
    """Whether a checkpoint with just these tensors is there already, so that its record alone needs writing."""
    if not record_path.exists():
        return False
    tensors_path = record_path.with_suffix(".safetensors")
    return tensors_path.exists() and hashlib.sha256(tensors_path.read_bytes()).hexdigest() == sha256


def _remove_orphans(folder: Path) -> None:
    """Remove tensors without a record: their writer was stopped before the checkpoint was one."""
    for path in folder.glob("step-*.safetensors"):
        if not path.with_suffix(".json").exists():
            path.unlink(missing_ok=True)


def _remove_others(folder: Path, step: int, keep: int) -> None:
    """Remove old checkpoints, and any newer than `step`: training went on from before them, so they are damaged."""
    steps = checkpoint_steps(folder)
    kept = [other for other in steps if other <= step][:keep]
    for other in set(steps) - set(kept):
        (folder / f"{_stem(other)}.json").unlink(missing_ok=True)  # the record first: never a record alone
        (folder / f"{_stem(other)}.safetensors").unlink(missing_ok=True)
