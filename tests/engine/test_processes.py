"""What several processes that train one model owe each other; what keeps them from it is said once, by the first."""

import io
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import distributed

from tests.engine.process_worker import STEPS, config_for, fixed_batch
from tests.factories.systems import needs_posix
from unmix_plugin.engine import processes
from unmix_plugin.engine.processes import (
    ALONE,
    Follower,
    Processes,
    joined,
    run_processes,
    start_together,
)
from unmix_plugin.engine.training.steps import prepare_steps
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.errors import ConfigError, RunError

ROOT = Path(__file__).resolve().parents[2]
SECOND_OF_TWO = {
    "RANK": 1,
    "WORLD_SIZE": 2,
    "LOCAL_RANK": 1,
    "LOCAL_WORLD_SIZE": 2,
    "MASTER_ADDR": "127.0.0.1",
    "MASTER_PORT": 29500,
}


@pytest.fixture
def second_of_two(monkeypatch):
    """The environment of the second process of two on one machine that has two GPUs."""
    for name, value in SECOND_OF_TWO.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", lambda _: None)
    return monkeypatch


@pytest.mark.parametrize(
    ("device", "lacking", "found", "message"),
    [
        ("cuda", "device_count", 1, "2 processes on this machine, which has 1 CUDA devices"),
        ("cuda", "is_nccl_available", False, "built without nccl"),
        ("cpu", "is_gloo_available", False, "built without gloo"),
    ],
)
def test_what_keeps_processes_from_working_together_is_told_by_the_first_alone(
    second_of_two, device, lacking, found, message
):
    where = torch.cuda if lacking == "device_count" else distributed
    second_of_two.setattr(where, lacking, lambda: found)
    with pytest.raises(Follower) as ended, joined(device):
        pass
    assert ended.value.code == 2
    second_of_two.setenv("LOCAL_RANK", "0")
    with pytest.raises(ConfigError, match=message), joined(device):
        pass


def test_a_process_that_was_started_alone_has_nothing_to_join(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with joined("cuda") as found:
        assert found is ALONE


MODULE = "tests.engine.process_worker"


@pytest.fixture
def run(tmp_path, capfd, monkeypatch):
    """Runs an action in two processes: exit code, standard error and what each process kept.

    None may leave threads of the group behind, which can abort a process when Python ends.
    """

    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # where these tests are

    def run_action(action):
        code = run_processes(MODULE, [str(tmp_path), action], 2)
        kept = [torch.load(path) for path in sorted(tmp_path.glob("rank-*.pt"))]
        left = [path.read_text() for path in tmp_path.glob("threads-*.txt")]
        assert left
        assert not any("gloo" in names for names in left), left
        return code, capfd.readouterr().err, kept

    return run_action


def test_the_gradient_of_a_batch_is_that_of_one_process(run, tmp_path):
    code, errors, (first, second) = run("gradients")
    assert code == 0, errors
    _, steps = prepare_steps(config_for(tmp_path))
    rays, batch = fixed_batch(steps.pipeline)
    losses = steps.pipeline.model.get_loss_dict(steps.pipeline.model(rays), batch)
    loss = torch.stack(list(losses.values())).sum()
    loss.backward()
    assert torch.allclose(first["loss"], loss.detach(), rtol=1e-6)
    for name, parameter in steps.pipeline.model.named_parameters():
        assert parameter.grad is not None
        assert torch.equal(first[name], second[name])
        scale = float(parameter.grad.abs().max())
        torch.testing.assert_close(first[name], parameter.grad, rtol=0, atol=1e-6 * scale)


@pytest.mark.slow
def test_two_processes_go_on_where_one_stopped_and_end_with_the_same_model(run, tmp_path):
    Trainer(config_for(tmp_path)).train()
    (training,) = (tmp_path / "outputs").glob("*/*/*/training.json")
    assert json.loads(training.read_text())["steps"] == STEPS
    code, errors, (first, second) = run("resume")
    assert code == 0, errors
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert json.loads(training.read_text())["steps"] == STEPS + 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("action", "message"),
    [
        ("other-seed", "process 2 of 2 has seed 5, the first has 4; start all with the same arguments"),
        ("no-scene", "process 2 of 2: no scene: give its folder with --data"),
        ("die", "can't reach the others, one of which has ended; what was saved before is whole"),
    ],
)
def test_a_failure_anywhere_ends_all_with_one_message(run, action, message):
    code, errors, kept = run(action)
    assert (code, kept) == (2, [])
    lines = [line for line in errors.splitlines() if line.startswith(("error:", "this is a bug"))]
    assert len(lines) == 1, errors
    assert message in lines[0]


@pytest.mark.slow
def test_ctrl_c_reaches_all_processes_and_what_was_learned_is_saved(run, tmp_path):
    code, errors, _ = run("interrupted")
    assert code != 2, errors
    assert "can't reach the others" not in errors
    assert list((tmp_path / "outputs").glob(f"*/*/*/checkpoints/step-{STEPS // 2 + 1:06d}.safetensors"))


def test_more_processes_than_rays_are_refused(tmp_path):
    _, steps = prepare_steps(config_for(tmp_path))
    steps.processes = Processes(0, 4)
    with pytest.raises(ConfigError, match="4 processes for 3 rays per step; use fewer processes"):
        steps.share_rays(3)


def test_alone_nothing_is_exchanged():
    values = torch.tensor([1.0, 2.0])
    assert ALONE.is_first
    assert ALONE.gather("word") == ["word"]
    assert ALONE.announce(0.5) == 0.5
    assert ALONE.of_first(ALONE.reduce(values, "mean")).tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"WORLD_SIZE": ""}, "WORLD_SIZE is '' in the environment; expected a number"),
        ({"WORLD_SIZE": "two"}, "WORLD_SIZE is 'two'"),
        ({"WORLD_SIZE": "0"}, "WORLD_SIZE is '0'"),
        ({"WORLD_SIZE": "2"}, "RANK and MASTER_ADDR and MASTER_PORT are not set"),
        ({"MASTER_ADDR": None}, "but MASTER_ADDR is not set"),
        ({"MASTER_PORT": "many"}, "MASTER_PORT is 'many'"),
        ({"RANK": "2"}, "RANK is '2' in the environment; expected a number from 0 to 1"),
        ({"LOCAL_RANK": "-1"}, "LOCAL_RANK is '-1'"),
    ],
)
def test_half_of_a_clusters_environment_is_refused_by_name(monkeypatch, variables, message):
    for name, value in SECOND_OF_TWO.items():
        if len(variables) == 1 and "WORLD_SIZE" in variables:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, str(value))
    for name, value in variables.items():
        monkeypatch.delenv(name) if value is None else monkeypatch.setenv(name, value)
    with pytest.raises(ConfigError, match=message), joined("cpu"):
        pass
    with pytest.raises(ConfigError, match=message):
        start_together("none", [], 2)


WAITING = """
import os, sys
from unmix_plugin.commands.entry import run_command
from unmix_plugin.engine.processes import joined
def wait(_):
    with joined("cpu"):
        pass
run_command(wait)
"""


def waiting(rank, port, address="127.0.0.1"):
    told = {"WORLD_SIZE": 2, "RANK": rank, "MASTER_ADDR": address, "MASTER_PORT": port}
    environment = {**os.environ, **{name: str(value) for name, value in told.items()}}
    return subprocess.Popen(
        [sys.executable, "-c", WAITING], env=environment, stderr=subprocess.PIPE, text=True
    )


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@needs_posix
@pytest.mark.parametrize("rank", [0, 1])
def test_a_process_that_waits_for_others_says_so_and_ends_on_signals(rank):
    process = waiting(rank, free_port())
    line = (process.stderr or io.StringIO()).readline()
    assert line.startswith("waiting for "), line
    assert "at most 10 minutes" in line
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=10)
    assert process.returncode == 128 + signal.SIGTERM


def test_processes_that_never_come_are_not_waited_for_without_end(second_of_two):
    second_of_two.setattr(processes, "_MEETING_S", 0.2)
    second_of_two.setenv("MASTER_PORT", str(free_port()))
    with pytest.raises(RunError, match="have all of them been started"), joined("cpu"):
        pass


@needs_posix
def test_the_store_listens_on_this_machine_alone_unless_a_clusters_address_is_given():
    own = socket.gethostbyname(socket.gethostname())
    for address, is_open in (("127.0.0.1", False), (own, True)):
        port = free_port()
        process = waiting(0, port, address)
        try:
            said = (process.stderr or io.StringIO()).readline()
            assert ("open to all who reach that network" in said) == (is_open and not own.startswith("127."))
            with socket.create_connection((address, port), timeout=5):
                pass
            if not is_open and not own.startswith("127."):
                with pytest.raises(ConnectionRefusedError):
                    socket.create_connection((own, port), timeout=5)
        finally:
            process.kill()
            process.communicate()
