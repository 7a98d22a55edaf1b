"""What is true of the distribution as a whole: what a wheel holds, and what an import costs."""

import configparser
import json
import os
import re
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path
from shutil import copytree, ignore_patterns

import pytest

from tests.test_public_surface import COMMANDS as COMMAND_MODULES
from tests.test_public_surface import METHODS

ROOT = Path(__file__).resolve().parents[1]
HEAVY = (
    *("colour", "scipy", "skimage", "matplotlib", "warp", "OpenEXR", "viser", "pandas", "tensorboard"),
    *("h5py", "tifffile", "PIL", "pycolmap", "cv2"),
)
ADDRESS = "https://example.org/unmix-nerf"
"""Where the repository would be."""
COMMANDS = ("train", "eval", "render", "demo_scene", "demo", "process", "view", "export")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel built from a copy, so that no build folder appears in the repository."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        (source / name).write_bytes((ROOT / name).read_bytes())
    project = (source / "pyproject.toml").read_text(encoding="utf-8")
    if "\nRepository = " not in project:
        project = project.replace("[project.urls]\n", f'[project.urls]\nRepository = "{ADDRESS}"\n')
    (source / "pyproject.toml").write_text(project, encoding="utf-8")
    copytree(ROOT / "unmix_plugin", source / "unmix_plugin", ignore=ignore_patterns("__pycache__"))
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "wheel", *options, "--wheel-dir", str(folder), str(source)]
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr
    [path] = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        yield archive


def metadata_file(wheel, name):
    [path] = [entry for entry in wheel.namelist() if entry.endswith(f".dist-info/{name}")]
    return wheel.read(path).decode()


@pytest.mark.slow
def test_a_wheel_holds_every_file_of_the_package_and_nothing_else(wheel):
    paths = (path for path in (ROOT / "unmix_plugin").rglob("*") if path.is_file())
    expected = {path.relative_to(ROOT).as_posix() for path in paths if "__pycache__" not in path.parts}
    assert {name for name in wheel.namelist() if ".dist-info/" not in name} == expected


@pytest.mark.slow
def test_a_wheel_declares_commands_and_methods(wheel):
    entry_points = configparser.ConfigParser()
    entry_points.read_string(metadata_file(wheel, "entry_points.txt"))
    assert sorted(entry_points["console_scripts"]) == sorted(COMMAND_MODULES)
    assert sorted(entry_points["unmix_plugin.method_configs"]) == sorted(METHODS)


@pytest.mark.slow
def test_a_wheel_carries_licence_readme_and_dependency_ranges(wheel):
    metadata = Parser().parsestr(metadata_file(wheel, "METADATA"))
    assert metadata["License-Expression"] == "Apache-2.0 AND MIT"  # MIT: three.js
    assert metadata["Requires-Python"] == ">=3.10"  # so that pip refuses older ones in one message
    assert metadata["Version"] == __import__("unmix_plugin").__version__
    needed = [line for line in metadata.get_all("Requires-Dist", []) if "extra ==" not in line]
    assert any(line.startswith("torch") for line in needed)
    assert not [line for line in needed if "==" in line]  # a library bounds its dependencies, but pins none
    assert "Apache License" in metadata_file(wheel, "licenses/LICENSE")


@pytest.mark.slow
def test_links_and_pictures_of_the_readme_work_away_from_the_repository(wheel):
    metadata = Parser().parsestr(metadata_file(wheel, "METADATA"))
    assert metadata["Description-Content-Type"] == "text/markdown"
    links = re.findall(r"\]\(([^)]+)\)", str(metadata.get_payload()))
    assert len(links) > 15
    assert [link for link in links if not link.startswith(("https://", "#"))] == []


def test_licences_of_code_that_is_shipped_are_named():
    """Of the bundle of three.js, which carries its own."""
    bundle = (ROOT / "unmix_plugin/products/page/three.js").read_text(encoding="utf-8")
    assert "The MIT License" in bundle
    assert '\nlicense = "Apache-2.0 AND MIT"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def commands_in(record):
    """All commands that a record of training and the records within it name."""
    nested = [
        command for value in record.values() if isinstance(value, dict) for command in commands_in(value)
    ]
    return [*nested, *([record["command"]] if "command" in record else [])]


@pytest.mark.parametrize(
    "path", sorted((ROOT / "unmix_plugin/neumatex/weights").glob("*.json")), ids=lambda path: path.name
)
def test_records_of_shipped_weights_name_modules_that_are_here(path):
    commands = commands_in(json.loads(path.read_text(encoding="utf-8")))
    assert commands
    for command in commands:
        python, option, module = command.split()[:3]
        assert (python, option) == ("python", "-m")
        assert (ROOT / f"{module.replace('.', '/')}.py").is_file()


def lines_printed_by(code):
    """Standard output of a fresh interpreter that runs the code."""
    command = [sys.executable, "-c", code]
    as_text = {"text": True, "errors": "replace"}
    finished = subprocess.run(command, capture_output=True, check=False, cwd=ROOT, **as_text)
    assert finished.returncode == 0, finished.stderr
    return finished.stdout.splitlines()


LIST_MODULES = "print(*{name.partition('.')[0] for name in sys.modules})"


def test_importing_the_package_imports_no_dependency():
    [modules] = lines_printed_by(f"import sys, unmix_plugin; {LIST_MODULES}")
    assert set(modules.split()).isdisjoint({*HEAVY, "torch", "numpy"})


def test_help_of_every_command_is_printed_without_a_heavy_package():
    """And without torch, but for `unmix-export`, whose products are asked for their options; it comes last."""
    found = lines_printed_by(
        "import importlib, sys\n"
        "scripts = importlib.import_module('unmix_plugin.commands.scripts')\n"
        f"for name in {COMMANDS}:\n"
        "    sys.argv = ['unmix', '--help']\n"
        "    try:\n        getattr(scripts, 'evaluate' if name == 'eval' else name)()\n"
        "    except SystemExit as stop:\n"
        f"        print('end:', name, stop.code, *[heavy for heavy in {(*HEAVY, 'torch')} if heavy in sys.modules])"
    )
    ends = [line.split() for line in found if line.startswith("end:")]
    assert ends[:-1] == [["end:", name, "0"] for name in COMMANDS[:-1]]
    assert ends[-1][:3] == ["end:", "export", "0"]
    assert set(ends[-1][3:]) <= {"torch", "warp"}


def in_a_new_process(code, **environment):
    """What Python code prints, started without what these tests set."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "OPENBLAS_"))}
    command = [sys.executable, "-W", "always", "-c", code]
    return subprocess.run(command, capture_output=True, text=True, check=True, env={**kept, **environment})


def test_torch_loads_with_threads_that_sleep_while_they_wait_from_python_too():
    """Threads that spin make everything many times slower as soon as anything else runs on the machine."""
    code = "import os, sys, unmix_plugin as u; print('torch' in sys.modules, os.environ['OMP_WAIT_POLICY'])"
    found = in_a_new_process(f"{code}; u.open_run; print('torch' in sys.modules)")
    assert found.stdout.split() == ["False", "PASSIVE", "True"]
    assert "OMP_WAIT_POLICY" not in found.stderr
    assert in_a_new_process(code, OMP_WAIT_POLICY="ACTIVE").stdout.split() == ["False", "ACTIVE"]


def test_commands_load_numpy_with_one_thread_for_its_products_unless_told_otherwise():
    shown = "print('numpy' in sys.modules, os.environ['OPENBLAS_NUM_THREADS'])"
    code = f"import os, sys, unmix_plugin.commands.scripts; {shown}"
    assert in_a_new_process(code).stdout.split() == ["False", "1"]
    assert in_a_new_process(code, OPENBLAS_NUM_THREADS="4").stdout.split() == ["False", "4"]
    assert (
        "OPENBLAS_NUM_THREADS" not in in_a_new_process("import os, unmix_plugin; print(*os.environ)").stdout
    )


def test_who_imports_torch_first_is_told_what_that_costs():
    code = "import torch; torch.set_num_threads({}); import unmix_plugin"
    assert "RuntimeWarning: torch was imported before unmix_plugin" in in_a_new_process(code.format(2)).stderr
    assert in_a_new_process(code.format(1)).stderr == ""
    assert in_a_new_process(code.format(2), OMP_WAIT_POLICY="ACTIVE").stderr == ""
