"""A signal at any moment, imports included, ends a command as signals do, and nobody is told of a bug."""

import os
import random
import re
import signal
import subprocess
import sys
import time

import pytest

from tests.factories.systems import needs_posix
from unmix_plugin.scenes.demo.scene import make_demo_scene

pytestmark = needs_posix
MOMENTS = 50
COMMANDS = {
    "train": ["unmix-nerf", "--data", "scene", "--max-num-iterations", "5", "--device", "cpu"],
    "evaluate": ["--run", "nowhere"],
    "export": ["poses", "--run", "nowhere"],
    "image": ["nowhere.hdr"],
    "process": ["cubes", "--data", "scene", "--output", "out"],
    "demo_scene": ["made", "--size", "32", "--overwrite"],
    "view": ["--run", "nowhere"],
}


def begun(folder, script, words):
    code = f"from unmix_plugin.commands import scripts; scripts.{script}()"
    return subprocess.Popen(
        [sys.executable, "-c", code, *words],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def check_moments(folder, script, words, moments, seed):
    """Send signals while a command runs and look how it ends."""
    make_demo_scene(folder / "scene", 16, 3, 4)
    started = time.monotonic()
    begun(folder, script, words).communicate(timeout=300)
    usual_s, chance = time.monotonic() - started, random.Random(seed)
    for _ in range(moments):
        number = chance.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
        process = begun(folder, script, words)
        time.sleep(chance.uniform(0.15, usual_s))  # before that it is Python that starts
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
        assert process.returncode in (0, 2, -number, 128 + number), said
        assert not re.search(r"this is a bug|Traceback", said), said


def test_a_signal_at_a_few_moments(tmp_path):
    check_moments(tmp_path, "demo_scene", COMMANDS["demo_scene"], 3, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("script", COMMANDS)
def test_a_signal_at_fifty_moments(tmp_path, script):
    check_moments(tmp_path, script, COMMANDS[script], MOMENTS, seed=2)
