"""Machines that lack something: one message each, which says what to do."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.factories.commands import run
from tests.factories.systems import needs_posix
from unmix_plugin.commands.demo_scene import write_demo_scene

ROOT = Path(__file__).resolve().parents[2]
DRAW = "from unmix_plugin.figures.plotting import figure_bytes; from matplotlib.figure import Figure; f = Figure(); "
START_WARP = "from unmix_plugin.operators.launching import warp; warp()"


def ended(work: str, folder: Path, before: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    """A command that does `work`, in a process of its own, in a folder; variables that are empty are not set."""
    code = (
        f"{before}\nfrom unmix_plugin.commands.entry import run_command\n"
        f"def command(_words):\n    {work}\nrun_command(command, [])"
    )
    kept = {name: value for name, value in {**os.environ, **environment}.items() if value}
    words = [sys.executable, "-c", code]
    return subprocess.run(words, env=kept, cwd=folder, capture_output=True, encoding="utf-8", check=False)


NO_CACHE = {"XDG_CACHE_HOME": "", "XDG_CONFIG_HOME": "", "WARP_CACHE_PATH": "", "MPLCONFIGDIR": ""}
NOBODY = "import pwd\npwd.getpwuid = {}.__getitem__"
"""As for a user whom a container does not know."""


@needs_posix
@pytest.mark.parametrize(("home", "before"), [("file/home", ""), ("", NOBODY)])
def test_a_home_folder_that_cannot_be_written_is_told_in_one_line(tmp_path, home, before):
    (tmp_path / "file").touch()
    where = {**NO_CACHE, "HOME": str(tmp_path / home) if home else "", "TMPDIR": str(tmp_path)}
    end = ended(f"{DRAW}figure_bytes(f); {START_WARP}", tmp_path, before, **where)
    assert end.returncode == 0, end.stderr
    [line] = end.stderr.splitlines()
    assert line.endswith("name one that can in the environment variable WARP_CACHE_PATH")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_figures_need_no_font_of_the_system_and_say_once_that_theirs_lacks_letters(tmp_path):
    alone = (
        "import matplotlib; from pathlib import Path; from matplotlib.font_manager import fontManager\n"
        "fontManager.ttflist = []\n"
        "for path in Path(matplotlib.get_data_path(), 'fonts/ttf').glob('*.ttf'): fontManager.addfont(path)"
    )
    draw = "f.text(0, 0, 'Bl\u00e4tter \u03b1 {}'); figure_bytes(f); "
    drawn = (
        DRAW + draw.format("") + "import sys; print('then', file=sys.stderr); " + draw.format("\u8449\u679c")
    )
    end = ended(drawn, tmp_path, alone, PYTHONIOENCODING="utf-8")
    assert end.returncode == 0
    [first, line] = end.stderr.splitlines()
    assert first == "then"
    assert line.startswith("warning: figures have boxes in place of letters such as \u8449")
    assert "Rename" in line


def test_a_missing_extra_is_told_with_the_command_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    end = run(write_demo_scene, tmp_path / "raw", "--raw", "--markers")
    assert end.status == 2
    [line] = end.err.splitlines()
    assert 'is not installed: python -m pip install "opencv-python-headless>=' in line
    assert not (tmp_path / "raw").exists()


@needs_posix
@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_refuses_a_python_that_is_too_old_and_says_how_to_name_another(tmp_path):
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    old = tmp_path / "python3.9"
    old.write_text(
        f"#!/bin/sh\nexec '{sys.executable}' -c 'import sys; sys.version_info = (3, 9, 18); exec(sys.argv[1])' \"$2\"\n"
    )
    old.chmod(0o755)
    words = ["make", f"PYTHON={old}", "demo"]
    end = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert end.returncode != 0
    said = "Python 3.10 or newer is needed; name one as in: make PYTHON=python3.12"
    assert end.stderr.splitlines()[0] == said
    assert not (tmp_path / ".venv").exists()
