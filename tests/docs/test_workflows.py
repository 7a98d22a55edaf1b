"""Workflows, hooks and CI scripts name only make targets, scripts and files that are here."""

import re
import shlex

import pytest
import yaml

from tests.factories.pages import ROOT, text_of

TARGETS = set(re.findall(r"^([\w-]+):(?!=)", text_of("Makefile"), re.MULTILINE))
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
SCRIPTS = sorted((ROOT / ".ci").iterdir())
OF_SHELLS = {"set", "cd", "status=0", "exit"}


def fault_of(line):
    """What is wrong with a line of a step, which may run a target of our Makefile or a script of ours; or None."""
    program, *words = shlex.split(line.partition("||")[0], comments=True) or ["set"]
    if program == "make":
        unknown = [word for word in words if "=" not in word and word not in TARGETS]
        return f"no target {unknown}" if unknown or not words else None
    if program in ("bash", "python"):
        program = words[0] if words else ""
    is_ours = program in OF_SHELLS or (ROOT / program).is_file()
    return None if is_ours else f"{program!r} is no script here"


def steps_of(workflow):
    jobs = yaml.safe_load(workflow.read_text(encoding="utf-8"))["jobs"]
    return [step for job in jobs.values() for step in job["steps"]]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_steps_run_what_is_here(workflow):
    steps = steps_of(workflow)
    assert steps
    for step in steps:
        assert "uses" in step or step["run"].strip(), step
        faults = [fault_of(line) for line in step.get("run", "").splitlines()]
        assert not any(faults), f"{step}: {faults}"


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_ci_scripts_run_what_is_here(script):
    faults = [fault_of(line) for line in script.read_text(encoding="utf-8").splitlines()]
    assert not any(faults), faults


def test_every_run_of_the_tests_is_also_one_of_ci():
    """So that what is green there is green here."""
    lines = {
        line for path in WORKFLOWS for step in steps_of(path) for line in step.get("run", "").splitlines()
    }
    assert {"make lint", "make test-all", "bash .ci/run", "bash .ci/release"} <= lines
    called = set(re.findall(r"^make .*?(?= \|\||$)", text_of(".ci/run"), re.MULTILINE))
    assert called == {"make lint", "make test"}
    assert "make test-all" in text_of(".ci/release")
    assert "`make test`" in text_of("README.md")
    [repository] = yaml.safe_load(text_of(".pre-commit-config.yaml"))["repos"]
    assert [fault_of(hook["entry"]) for hook in repository["hooks"]] == [None]


def test_the_oldest_python_that_is_tested_is_the_oldest_allowed():
    matrix = yaml.safe_load(text_of(".github/workflows/tests.yml"))["jobs"]["tests"]["strategy"]["matrix"]
    [oldest] = re.findall(r'^requires-python = ">=(.*)"$', text_of("pyproject.toml"), re.MULTILINE)
    assert min(matrix["python"], key=lambda version: int(version.partition(".")[2])) == oldest
    assert {"ubuntu-latest", "macos-latest", "windows-latest"} == set(matrix["system"])
