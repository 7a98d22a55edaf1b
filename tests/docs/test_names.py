"""Flags and dotted names that the pages mention are there."""

import importlib
import re

import pytest

from tests.factories.commands import run
from tests.factories.pages import ROOT, text_of
from tests.test_public_surface import METHODS
from unmix_plugin.commands.process_inspect import inspect_command
from unmix_plugin.commands.train import train

PAGES = ["README.md", *(path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "docs").rglob("*.md")))]
_OTHERS = """--debug --constraint --help-all --index-url --logdir --pipeline --pipeline.model.resolution --rows --seeds
    --folder --start --count --first-seed --demo-share --training.nll-from --training.nll-full-from
    --nnodes --nproc-per-node --rdzv-backend --rdzv-endpoint --nodes --ntasks-per-node --gpus-per-node"""
OF_OTHERS = set(_OTHERS.split())
"""Taken before a command sees them; of pip, benchmarks, training scripts, torchrun and Slurm."""


@pytest.fixture(scope="module")
def flags():
    """Every flag of every command: those on record, which another test compares, and what the record leaves out."""
    asked = [(inspect_command, ["--help"]), *((train, [method, "--help-all"]) for method in METHODS)]
    pages = [text_of("tests/public_surface.txt"), *(run(command, *words).out for command, words in asked)]
    return {flag for page in pages for flag in re.findall(r"--[a-z0-9][\w.-]*", page)}


@pytest.mark.parametrize("page", PAGES)
def test_flags_are_those_of_the_commands(page, flags):
    named = {flag.rstrip(".-") for flag in re.findall(r"(?<![\w-])--[a-z0-9][\w.-]*", text_of(page))}
    assert named - flags - OF_OTHERS == set()


@pytest.mark.parametrize("page", PAGES)
def test_dotted_names_of_the_package_are_there(page):
    for name in set(re.findall(r"\bunmix_plugin(?:\.\w+)+", text_of(page))) - {"unmix_plugin.method_configs"}:
        parts = name.split(".")
        found = importlib.import_module("unmix_plugin")
        for count, part in enumerate(parts[1:], start=2):
            if not hasattr(found, part):
                importlib.import_module(".".join(parts[:count]))
            found = getattr(found, part)


def test_the_page_of_flags_has_every_flag_of_the_method():
    page = text_of("docs/reference/flags.md")
    recorded = text_of("tests/public_surface.txt").splitlines()
    options = [line.split()[2:] for line in recorded if line.startswith("unmix-train unmix-nerf --")]
    names = [[word.strip(",") for word in option if word.startswith("--")] for option in options]
    shown = [[name.rpartition(".no-")[2] if ".no-" in name else name for name in option] for option in names]
    assert [option for option in shown if not any(name in page for name in option)] == []
