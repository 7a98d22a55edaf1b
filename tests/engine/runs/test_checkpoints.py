"""Checkpoints survive a stop at any system call, a full disk, and damage to the newest."""

import contextlib
import errno
import itertools
import math
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.factories.systems import needs_posix
from unmix_plugin.engine.runs import atomic_files
from unmix_plugin.engine.runs.checkpoints import newest_complete_checkpoint, save_checkpoint
from unmix_plugin.engine.runs.run_folder import checkpoint_steps
from unmix_plugin.errors import RunError


def tensors_of(step: int) -> dict[str, Tensor]:
    return {"a": torch.full((40, 3), float(step)), "n": torch.tensor(step)}


def bytes_of(tensor: Tensor) -> list[int]:
    return tensor.detach().contiguous().reshape(-1).view(torch.uint8).tolist()


class Killed(BaseException):
    """Stands for SIGKILL: nothing that runs after it has any effect."""


@contextlib.contextmanager
def failing_at(number: int, error: type[BaseException]) -> Iterator[list[str]]:
    """Notes system calls; that number of them raises, and of a killed process all later ones."""
    calls: list[str] = []

    def wrapped(name: str, real: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            if error is OSError and name == "unlink":  # a full disk refuses to grow files alone
                return real(*args, **kwargs)
            calls.append(name)
            if len(calls) == number or (error is Killed and len(calls) > number):
                if name == "write" and len(calls) == number:
                    real(args[0], args[1][: len(args[1]) // 2])
                raise error(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return real(*args, **kwargs)

        return call

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(atomic_files, "CHUNK_BYTES", 200)
        for name in ("open", "write", "fsync", "replace", "unlink"):
            monkeypatch.setattr(os, name, wrapped(name, getattr(os, name)))
        yield calls


def failed_saves(
    folder: Path, error: type[BaseException], keep: int, *, is_again: bool = False
) -> Iterator[tuple[Path, str]]:
    """Folders with step 1 to which step 2 was saved, for the second time if `is_again`, failing at each system call in
    turn, and what was said."""
    for number in itertools.count(1):
        place, said = folder / str(number), ""
        save_checkpoint(place, 1, tensors_of(1), {})
        if is_again:
            save_checkpoint(place, 2, tensors_of(2), {"seconds": 1})
        with failing_at(number, error) as calls:
            try:
                save_checkpoint(place, 2, tensors_of(2), {}, keep=keep)
            except (Killed, RunError) as stopped:
                said = str(stopped)
        if len(calls) < number:
            assert number > (6 if is_again else 12)
            return
        yield place, said


def test_a_checkpoint_comes_back_to_the_bit(tmp_path):
    base = torch.arange(12.0).reshape(3, 4)
    tensors = {
        "float": torch.randn(5, 7),
        "double": torch.randn(3, dtype=torch.float64),
        "flags": torch.tensor([True, False]),
        "scalar": torch.tensor(3.5),
        "empty": torch.zeros(0, 4),
        "half": torch.randn(4).to(torch.bfloat16),
        "byte": torch.randn(4).to(torch.float8_e4m3fn),
        "base": base,
        "transposed": base.T,
        "row": base[1],
        "again": base,  # as what views show
        "parameter": torch.nn.Parameter(base.clone()),
    }
    path = save_checkpoint(tmp_path / "new", 7, tensors, {"seconds": 1.25, "list": [1, "x", None]})
    assert path.name == "step-000007.json"
    loaded = newest_complete_checkpoint(tmp_path / "new")
    assert (loaded.step, loaded.record["seconds"], loaded.record["list"]) == (7, 1.25, [1, "x", None])
    assert set(loaded.tensors) == set(tensors)
    for name, tensor in tensors.items():
        assert loaded.tensors[name].dtype == tensor.dtype
        assert loaded.tensors[name].shape == tensor.shape
        assert bytes_of(loaded.tensors[name]) == bytes_of(tensor)


@pytest.mark.parametrize("same_step", [False, True])
def test_a_kill_at_any_system_call_leaves_a_complete_checkpoint(tmp_path, same_step):
    seen: set[int] = set()
    for folder, _ in failed_saves(tmp_path, Killed, keep=1 + same_step, is_again=same_step):
        found = newest_complete_checkpoint(folder)
        assert found.damaged == ()
        assert torch.equal(found.tensors["a"], tensors_of(found.step)["a"])
        seen.add(found.step)
        save_checkpoint(folder, 3, tensors_of(3), {}, keep=1)
        assert {path.name for path in folder.glob("[!.]*")} == {"step-000003.json", "step-000003.safetensors"}
    assert seen == ({2} if same_step else {1, 2})


@pytest.mark.parametrize("same_step", [False, True])
def test_a_full_disk_at_any_system_call_is_said_and_changes_nothing(tmp_path, same_step):
    for folder, said in failed_saves(tmp_path, OSError, keep=2, is_again=same_step):
        assert "No space left on device" in said
        names = {path.name for path in folder.iterdir()}
        assert not [name for name in names if name.endswith(".tmp")]
        assert {"step-000001.json", "step-000001.safetensors"} <= names
        found = newest_complete_checkpoint(folder)
        assert found.damaged == ()
        assert found.step == 2 or not same_step


@pytest.mark.slow
@needs_posix
def test_twenty_real_kills_during_saving_leave_complete_checkpoints(tmp_path):
    words = [sys.executable, "-c", KILLING, str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    steps = [int(word) for word in done.stdout.split()]
    assert len(steps) == 20
    assert steps == sorted(steps)
    assert steps[-1] > steps[0]


KILLING = """
import os, random, signal, sys
from pathlib import Path
import torch
from unmix_plugin.engine.runs.checkpoints import newest_complete_checkpoint, save_checkpoint

folder, chance = Path(sys.argv[1]), random.Random(1)
save_checkpoint(folder, 1, {"a": torch.full((300_000,), 1.0)}, {})
for _ in range(20):
    start = newest_complete_checkpoint(folder).step
    saved, tell = os.pipe()
    child = os.fork()
    if child == 0:
        for step in range(start + 1, start + 10_000):
            save_checkpoint(folder, step, {"a": torch.full((300_000,), float(step))}, {})
            os.write(tell, b".")
        os._exit(0)
    for _ in range(chance.randint(1, 4)):
        os.read(saved, 1)
    os.kill(child, signal.SIGKILL)  # in the middle of the next save
    os.waitpid(child, 0)
    found = newest_complete_checkpoint(folder)
    assert found.damaged == (), found.damaged
    assert found.tensors["a"].unique().tolist() == [float(found.step)]
    print(found.step)
"""


def test_damage_to_the_newest_falls_back_to_the_one_before(tmp_path):
    for step in (1, 2):
        save_checkpoint(tmp_path, step, tensors_of(step), {})
    path = tmp_path / "step-000002.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    found = newest_complete_checkpoint(tmp_path)
    assert found.step == 1
    assert "step-000002" in found.damaged[0]
    path.unlink()
    assert newest_complete_checkpoint(tmp_path).step == 1
    (tmp_path / "step-000002.json").write_text('{"format_ver')
    assert newest_complete_checkpoint(tmp_path).step == 1


def test_the_newest_two_stay_and_a_damaged_one_does_not_count_among_them(tmp_path):
    for folder in (tmp_path / "missing", tmp_path):
        with pytest.raises(RunError, match=r"no complete checkpoint in .*: training ended before the first"):
            newest_complete_checkpoint(folder)
    for step in (10, 999_999, 1_000_000, 1_000_001):
        save_checkpoint(tmp_path / "many", step, tensors_of(step), {})
    assert checkpoint_steps(tmp_path / "many") == [1_000_001, 1_000_000]
    assert len(list((tmp_path / "many").glob("[!.]*"))) == 4
    for step in (1, 2, 9):
        save_checkpoint(tmp_path, step, tensors_of(step), {}, keep=3)
    (tmp_path / "step-000009.safetensors").write_bytes(b"damaged")
    save_checkpoint(tmp_path, 3, tensors_of(3), {}, keep=2)
    assert checkpoint_steps(tmp_path) == [3, 2]


def test_tensors_that_could_not_be_read_are_refused_and_push_out_no_checkpoint(tmp_path):
    for step in (1, 2):
        save_checkpoint(tmp_path, step, tensors_of(step), {}, keep=1)
    for name, value in (("model/mean", math.nan), ("average/a", math.inf)):
        with pytest.raises(RunError, match=f"{name} has values that are not finite"):
            save_checkpoint(tmp_path, 3, {name: torch.full((2,), value)}, {}, keep=1)
    assert newest_complete_checkpoint(tmp_path).step == 2


def test_saving_the_same_tensors_again_only_rewrites_the_record(tmp_path):
    save_checkpoint(tmp_path, 1, tensors_of(1), {"seconds": 1})
    before = (tmp_path / "step-000001.safetensors").stat().st_mtime_ns
    save_checkpoint(tmp_path, 1, tensors_of(1), {"seconds": 2})
    assert newest_complete_checkpoint(tmp_path).record["seconds"] == 2
    assert (tmp_path / "step-000001.safetensors").stat().st_mtime_ns == before
