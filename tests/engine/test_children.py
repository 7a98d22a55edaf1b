"""Processes that commands start run our code, whatever lies in the folder that they are started in."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from unmix_plugin.engine.children import child_command

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def hostile(tmp_path):
    """A folder of somebody's with modules that are called as those that we import."""
    for name in (
        "tyro",
        "json",
        "numpy",
        "torch",
        "runpy",
        "importlib",
        "signal",
        "sitecustomize",
        "unmix_plugin",
    ):
        (tmp_path / f"{name}.py").write_text("open('ran', 'w').close(); raise SystemExit(77)")
    return tmp_path


def started(hostile, command, **environment):
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return subprocess.run(
        command, cwd=hostile, env=kept | environment, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        pytest.param("unmix_plugin.commands.render", ["--run", "nowhere"], marks=pytest.mark.slow),
        pytest.param(
            "unmix_plugin.commands.eval", ["--run", "nowhere", "--num-devices", "2"], marks=pytest.mark.slow
        ),
        ("unmix_plugin.captures.poses.estimation", ["nowhere.json"]),
    ],
)
def test_a_child_imports_nothing_from_where_it_is_started(hostile, module, arguments):
    ended = started(hostile, child_command(module, arguments))
    assert not (hostile / "ran").exists(), ended.stderr
    assert ended.returncode == (1 if "estimation" in module else 2), ended.stderr
    assert "nowhere" in ended.stderr


def test_what_the_user_has_in_pythonpath_stays(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "my_plugin.py").write_text("")
    (tmp_path / "mine" / "shown.py").write_text(
        "import my_plugin, unmix_plugin; print(unmix_plugin.__file__)"
    )
    ended = started(tmp_path, child_command("shown", []), PYTHONPATH=str(tmp_path / "mine"))
    assert Path(ended.stdout.strip()) == ROOT / "unmix_plugin" / "__init__.py", ended.stderr


def test_it_is_the_way_of_every_python_that_the_package_starts():
    for path in (ROOT / "unmix_plugin").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert path.name == "children.py" or "sys.executable" not in text, path
        assert "multiprocessing" not in text, path


@pytest.mark.skipif(sys.version_info < (3, 11), reason="PYTHONSAFEPATH is of 3.11")
def test_a_python_that_is_safe_already_loses_no_path(tmp_path):
    (tmp_path / "shown.py").write_text("import sys; print(sys.path[0])")
    ended = started(tmp_path, child_command("shown", []), PYTHONPATH=str(tmp_path), PYTHONSAFEPATH="1")
    assert ended.stdout.strip() == str(tmp_path), ended.stderr
