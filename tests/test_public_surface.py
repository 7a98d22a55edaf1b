"""What users can ask for: commands, products, flags, outputs, layouts and public names, listed in public_surface.txt.

A change of the list is a change for users: `python -m tests.test_public_surface` writes it anew, and the commit that
changes it shows it.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from unittest import mock

import unmix_plugin
from unmix_plugin import engine

RECORD = Path(__file__).with_name("public_surface.txt")
COMMANDS = {
    "unmix-asset": ("asset", "asset"),
    "unmix-compare": ("compare", "compare"),
    "unmix-demo": ("demo", "demo"),
    "unmix-demo-scene": ("demo_scene", "write_demo_scene"),
    "unmix-eval": ("eval", "evaluate"),
    "unmix-export": ("export", "export"),
    "unmix-image": ("image", "image"),
    "unmix-process": ("process", "process"),
    "unmix-render": ("render", "render"),
    "unmix-train": ("train", "train"),
    "unmix-view": ("view", "view"),
}
METHODS = ("unmix-nerf", "unmix-nerf-published", "neumatex")


def test_what_users_can_ask_for_is_what_the_record_lists():
    assert list(public_surface()) == RECORD.read_text().splitlines()


def public_surface() -> Iterator[str]:
    """One line for each thing that a user can name."""
    for name in COMMANDS:
        text = help_of(name, "--help")
        yield from _of_page(name, text)
        for choice in _subcommands(text):
            yield from _of_page(f"{name} {choice}", help_of(name, choice, "--help"))
    [outputs] = re.findall(r"--outputs .*?(?=\(default)", help_of("unmix-render", "--help"), re.DOTALL)
    yield "unmix-render " + " ".join(outputs.split())
    for method in METHODS:
        common = set(_of_page("", help_of("unmix-train", method, "--help")))
        for line in _of_page("", help_of("unmix-train", method, "--help-all")):
            yield f"unmix-train {method}{line}{' (common)' if line in common else ''}"
    yield "unmix-process inspect"
    yield from (f"unmix_plugin.{name}" for name in sorted(unmix_plugin.__all__))
    yield from (f"unmix_plugin.engine.{name}" for name in sorted(engine.__all__))


def help_of(command: str, *words: str) -> str:
    """What a command prints."""
    module, function = COMMANDS[command]
    out = io.StringIO()
    wide = mock.patch.dict(os.environ, {"COLUMNS": "400", "TERM": "dumb", "NO_COLOR": "1"})
    with wide, contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        getattr(import_module(f"unmix_plugin.commands.{module}"), function)(list(words))
    return out.getvalue()


def _of_page(name: str, text: str) -> list[str]:
    """A page of help, its flags in the order of the alphabet."""
    layouts = re.findall(r"(?<=  )\{[a-z-]+,[a-z,-]+\}(?=  )", text)
    flags = re.findall(r"(?<=  )-{1,2}[a-z][\w.-]*(?:, -{1,2}[a-z][\w.-]*)*(?: \{[^}]*\})?", text)
    return [name, *sorted({f"{name} {' '.join(word.split())}" for word in (*layouts, *flags)})]


def _subcommands(text: str) -> list[str]:
    return re.findall(r"^[│ ]*• ([a-z-]+)", text, re.MULTILINE)


if __name__ == "__main__":
    RECORD.write_text("\n".join(public_surface()) + "\n")
