"""Results that pages cite: each names the clean revision that it was measured at, and what it depends on is known."""

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys

import pytest

from tests.factories.pages import ROOT, text_of


def module_of(path):
    """A script of the repository."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


DEPENDS = module_of(ROOT / "benchmarks/_depends.py")
CHECK = module_of(ROOT / "scripts/check_results.py")
TABLE = module_of(ROOT / "scripts/results_table.py")
TO_MEASURE_AGAIN = {
    "gpu": "python benchmarks/gpu.py",
}
"""Results that are not clean, each with the command that measures it again. No other may join them."""


@pytest.mark.parametrize("result", CHECK.cited_results())
def test_a_cited_result_is_of_a_clean_revision(result):
    fault = CHECK.fault_of(result)
    assert (fault is not None) == (result in TO_MEASURE_AGAIN), fault


def test_results_to_measure_again_are_still_cited():
    assert set(TO_MEASURE_AGAIN) <= set(CHECK.cited_results())


@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("[a-z]*.py")), ids=lambda path: path.stem)
def test_every_benchmark_states_what_it_measures(path):
    if path.stem != "scenes":  # it makes what others measure
        assert DEPENDS.DEPENDS_ON[path.stem]
        assert all((ROOT / part).exists() for part in DEPENDS.measured_by(path.stem))


def test_every_result_is_of_a_benchmark_that_is_here():
    stems = {path.stem for path in (ROOT / "benchmarks/results").glob("*.md")} - {"tried"}
    assert {DEPENDS.benchmark_of(stem) for stem in stems} <= set(DEPENDS.DEPENDS_ON)


def test_readme_shows_the_results_that_are_committed():
    report = json.loads((ROOT / "benchmarks/results/quality.json").read_text(encoding="utf-8"))
    assert TABLE.with_results(text_of("README.md"), report) == text_of("README.md")


def test_of_drawn_scenes_the_mean_and_the_worst_are_shown():
    figures = {
        "bands": 21,
        "psnr": 30.0,
        "psnr_matter": 28.0,
        "sam": 0.02,
        "miou": 0.8,
        "abundance_rmse": 0.1,
    }
    worse = figures | {"psnr": 20.0, "sam": 0.06, "miou": 0.4}
    measured = {f"unseen-{k}": {"metrics": values} for k, values in enumerate((figures, worse), start=1)}
    mean, worst = TABLE.table(measured).splitlines()[-2:]
    assert mean == "| 2 drawn scenes: mean | 21 | 25.0 dB | 28.0 dB | 0.040 rad | 0.60 | 0.100 |"
    assert worst == "| and the worst of each | 21 | 20.0 dB | 28.0 dB | 0.060 rad | 0.40 | 0.100 |"


WITHOUT_SCENES = {
    "captures_training": "turntable",
    "editing": "table",
    "equal_steps": "table",
    "export_speed": "table",
    "few_views": "table",
    "field_first": "table",
    "quality": "table",
    "unmixing": "table",
}
"""The first scene that each benchmark misses where there is none."""


@pytest.mark.parametrize("name", WITHOUT_SCENES)
def test_a_benchmark_without_its_scenes_ends_with_2_and_says_what_makes_them(name, tmp_path):
    words = [
        sys.executable,
        ROOT / f"benchmarks/{name}.py",
        *(["--before", ROOT] if name == "equal_steps" else []),
    ]
    env = {**os.environ, "UNMIX_BENCHMARK_SCENES": str(tmp_path)}
    ended = subprocess.run(words, capture_output=True, text=True, check=False, env=env)
    assert ended.returncode == 2, ended.stderr
    assert f"the scene {WITHOUT_SCENES[name]} is missing" in ended.stderr
    assert f"python benchmarks/scenes.py --only {WITHOUT_SCENES[name]}" in ended.stderr


def test_a_capture_that_was_asked_for_but_not_given_ends_with_2():
    words = [sys.executable, ROOT / "benchmarks/captures_training.py", "--only", "basil"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 2, ended.stderr
    assert "Basil is missing: name the folder of its files (--basil)" in ended.stderr


def test_a_folder_without_scenes_is_no_result(tmp_path):
    words = [sys.executable, ROOT / "benchmarks/quality.py", "--scenes", tmp_path]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 2, ended.stderr
    assert "any scene is missing" in ended.stderr


def test_no_benchmark_looks_beside_the_repository():
    sources = {path.name: path.read_text(encoding="utf-8") for path in (ROOT / "benchmarks").glob("*.py")}
    assert [
        name for name, text in sources.items() if "REPOSITORY.parent" in text.replace("parent.parent", "")
    ] == []


def _asks_for_something(path):
    """Whether a benchmark has an option without a default."""
    (options,) = [
        node
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and node.name == "Options"
    ]
    return any(isinstance(line, ast.AnnAssign) and line.value is None for line in options.body)


def test_make_bench_runs_every_benchmark_that_needs_no_argument():
    [words] = re.findall(r"patsubst %,benchmarks/%\.py,([^)]*)\)", text_of("Makefile"))
    left_out, paths = set(words.split()), sorted((ROOT / "benchmarks").glob("[a-z]*.py"))
    asking = {path.stem for path in paths if _asks_for_something(path)}
    assert left_out == asking | {"scenes"}
