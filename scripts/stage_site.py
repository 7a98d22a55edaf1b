"""Collects what the site is built from in one folder: `python scripts/stage_site.py FOLDER`.

The pages of docs/, the changelog, the measured results, and pages of reference that are made from the code: each
command with its flags, and the public Python names. Links between them are made to fit their new places.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
import sys
import warnings
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import tyro

import unmix_plugin
from unmix_plugin import engine, errors

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = {
    "unmix-demo": ("demo", "demo", ("",)),
    "unmix-process": ("process", "process", ("", "inspect")),
    "unmix-train": ("train", "train", ("unmix-nerf", "unmix-nerf-published", "neumatex")),
    "unmix-eval": ("eval", "evaluate", ("",)),
    "unmix-render": ("render", "render", ("",)),
    "unmix-export": ("export", "export", ("",)),
    "unmix-asset": ("asset", "asset", ("",)),
    "unmix-compare": ("compare", "compare", ("",)),
    "unmix-view": ("view", "view", ("",)),
    "unmix-image": ("image", "image", ("",)),
    "unmix-demo-scene": ("demo_scene", "write_demo_scene", ("",)),
}
"""Module, function, and the words after which flags differ."""
ROOMS = {
    "captures": "Captures: `unmix-process`, `unmix-image`",
    "engine": "Runs and training: every command",
    "trained": "Views, regions and cameras: `unmix-render`, `unmix-export`, `unmix-eval`",
    "products": "Products: `unmix-export`, `unmix-render`",
    "comparing": "Changes: `unmix-compare`",
    "formats": "Files of spectra, meshes and videos",
    "spectral": "Spectra, colours, indices and unmixing",
    "editing": "Recipes: `--edits`",
    "viewer": "The page in the browser: `unmix-view`, `unmix-train`",
    "neumatex": "The method neumatex",
    "commands": "Words of commands",
}
"""Parts of the package whose messages are listed, and who says them; those of scenes have a table by hand."""


def main() -> None:
    """Console entry."""
    folder = Path(sys.argv[1])
    places = {
        ROOT / "CHANGELOG.md": folder / "changelog.md",
        ROOT / "CONTRIBUTING.md": folder / "contributing.md",
    }
    for path in sorted((ROOT / "docs").rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            places[path] = folder / path.relative_to(ROOT / "docs")
    for path in sorted((ROOT / "benchmarks/results").glob("*.md")):
        places[path] = folder / "results" / path.name
    aliases = {
        ROOT / "README.md": folder / "index.md",
        ROOT / "benchmarks/results": folder / "results/index.md",
    }
    for path, place in places.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".md":
            text = path.read_text(encoding="utf-8")
            place.write_text(_relinked(text, path, place, places | aliases), encoding="utf-8")
        else:
            shutil.copyfile(path, place)
    _write(folder / "results/index.md", _results_index(sorted((folder / "results").glob("*.md"))))
    names = [_write_command(folder / "reference/commands", name) for name in COMMANDS]
    _write(folder / "reference/commands/index.md", _commands_index(names))
    _write(folder / "reference/messages.md", _messages_page(ROOT / "unmix_plugin"))
    _write(folder / "reference/python-api.md", _python_page())
    _write(folder / "reference/engine-api.md", _engine_page())
    _write(folder / "index.md", _front_page((folder / "index.md").read_text(encoding="utf-8")))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _relinked(text: str, path: Path, place: Path, places: dict[Path, Path]) -> str:
    """A page whose links lead to where its neighbours now lie; those to files that the site lacks are plain text."""

    def link(match: re.Match[str]) -> str:
        label, target, anchor = match.groups()
        found = places.get((path.parent / target).resolve())
        return label if found is None else f"[{label}]({os.path.relpath(found, place.parent)}{anchor or ''})"

    return re.sub(r"(?<!!)\[([^\]]+)\]\((?!https?:|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)", link, text)


def _toctree(caption: str, pages: list[str], hidden: bool = True) -> str:
    options = [f":caption: {caption}"] if caption else []
    options += [":hidden:"] if hidden else []
    return "\n".join(["```{toctree}", *options, "", *pages, "```", ""])


def _front_page(text: str) -> str:
    """The index, with the pages that are made here, and what its tables list as the site's contents."""
    made = {
        "Reference": [
            ("reference/commands/index", "commands", "every command with all its flags, made from the code"),
            ("reference/messages", "messages", "what errors say, and what to do"),
            (
                "reference/python-api",
                "Python names",
                "classes and functions of `unmix_plugin`, from their docstrings",
            ),
            ("reference/engine-api", "engine names", "what a method of your own is made of"),
        ],
        "Background": [
            (
                "results/index",
                "measured results",
                "every figure that these pages quote, with how it was measured",
            ),
            ("contributing", "contributing", "set-up, tests, where things go"),
            ("changelog", "changelog", "what each release brings"),
        ],
    }
    text = re.sub(r"The \[README\]\(index\.md\) [^.]*\. ", "", text)  # which is this page
    trees = []
    for section in re.split(r"^(?=## )", text, flags=re.MULTILINE)[1:]:
        title = section.splitlines()[0].removeprefix("## ").split(":")[0]
        rows = made.get(title, [])
        more = "".join(f"| [{label}]({page}.md) | {what} |\n" for page, label, what in rows)
        head, line, tail = section.partition("|---|---|\n")
        text = text.replace(section, head + line + more + tail)
        listed = [row for row in tail.splitlines() if row.startswith("|")]
        pages = re.findall(r"\]\(([\w/-]+)\.(?:md|ipynb)\)", "\n".join(listed))
        if pages:
            trees.append(_toctree(title, [page for page, *_ in rows] + pages))
    return text + "\n" + "\n".join(trees)


def _results_index(pages: list[Path]) -> str:
    rows = []
    for page in pages:
        title, _, about = page.read_text(encoding="utf-8").splitlines()[:3]
        rows.append(f"| [{title.lstrip('# ')}]({page.name}) | {about} |")
    head = [
        "# Measured results",
        "",
        "Each page is written by the script in `benchmarks/` of its name, and says on which machine and when.",
        "",
        "| page | |",
        "|---|---|",
    ]
    return "\n".join([*head, *rows, "", _toctree("", [page.stem for page in pages])])


def _python_page() -> str:
    mistakes = [
        name
        for name, one in vars(errors).items()
        if isinstance(one, type) and issubclass(one, errors.UnmixError)
    ]
    members = {"Recipe", "Light"}
    parts = [
        "# Python names",
        "",
        "[From Python](../guides/python.md) shows them at work.",
        "",
        "## unmix_plugin",
        "",
    ]
    for name in unmix_plugin.__all__:
        parts += _autodoc(f"unmix_plugin.{name}", getattr(unmix_plugin, name), name not in members)
    parts += ["## unmix_plugin.editing", "", "The edits that a recipe is made of.", ""]
    editing = import_module("unmix_plugin.editing")
    for name in editing.__all__:
        if name not in unmix_plugin.__all__:
            parts += _autodoc(f"unmix_plugin.editing.{name}", getattr(editing, name), True)
    parts += ["## unmix_plugin.errors", ""]
    for name in mistakes:
        parts += _autodoc(f"unmix_plugin.errors.{name}", getattr(errors, name), False)
    return "\n".join(parts)


def _messages_page(package: Path) -> str:
    """The messages of users' errors that also say what is expected or what to do, as the code has them."""
    kinds = {
        name
        for name, one in vars(errors).items()
        if isinstance(one, type) and issubclass(one, errors.UnmixError)
    }
    parts = [
        "# Messages",
        "",
        "What commands say of files, settings and runs that they can't use, with exit code 2; `...` stands for names",
        "and numbers. Search this page for words of your message. Faults of a scene folder have",
        "[a table of their own](scene-folder.md#when-a-scene-is-refused).",
        "",
    ]
    for room, title in ROOMS.items():
        said = dict.fromkeys(
            pair
            for path in sorted((package / room).rglob("*.py"))
            for pair in messages_in(path.read_text(encoding="utf-8"), kinds)
        )
        rows = [f"| {what} | {advice} |" for what, advice in said]
        parts += [f"## {title}", "", "| the message says | expected, or what to do |", "|---|---|", *rows, ""]
    return "\n".join(parts)


def messages_in(code: str, kinds: set[str]) -> Iterator[tuple[str, str]]:
    """What each message in a module says, and what it expects or advises, as cells of a table."""
    for call in ast.walk(ast.parse(code)):
        if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in kinds):
            continue
        for text in call.args[:1]:
            pieces = text.values if isinstance(text, ast.JoinedStr) else [text]
            words = [str(one.value) if isinstance(one, ast.Constant) else "..." for one in pieces]
            what, _, advice = re.sub(r"^(\.\.\.:? )+", "", "".join(words)).partition("; ")
            if len(re.sub(r"\W", "", what)) > 8 and re.search(r"\w", advice):
                yield _cell(what), _cell(advice)


def _cell(text: str) -> str:
    """Any text in a table of Markdown, as it is."""
    return re.sub(r"([\\`*_{}\[\]<>#|~$])", r"\\\1", " ".join(text.split()))


def _engine_page() -> str:
    parts = ["# Engine names", "", "What [a method of your own](../guides/plugins.md) is made of.", ""]
    for name in sorted(set(engine.__all__) - set(unmix_plugin.__all__)):
        parts += _autodoc(f"unmix_plugin.engine.{name}", getattr(engine, name), True)
    return "\n".join(parts)


def _autodoc(name: str, thing: object, with_members: bool) -> list[str]:
    kind = "autoclass" if isinstance(thing, type) else "autofunction" if callable(thing) else "autodata"
    members = ["   :members:"] if kind == "autoclass" and with_members else []
    return ["```{eval-rst}", f".. {kind}:: {name}", *members, "```", ""]


class _Found(BaseException):
    """Ends a command where it would read its arguments."""

    def __init__(self, parser: Any, words: Sequence[str]) -> None:
        self.parser, self.words = parser, list(words)


def parser_of(command: str, words: list[str]) -> tuple[argparse.ArgumentParser, list[str]]:
    """The parser that a command makes for `words`, and those of them that it would parse."""
    module, function, _ = COMMANDS[command]
    read = tyro.cli

    def cli(kind: Any, **options: Any) -> Any:
        if options.pop("return_unknown_args", False):
            return read(kind, **options, return_unknown_args=True)
        words = options.pop("args")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            raise _Found(tyro.extras.get_parser(kind, **options), words)

    with mock.patch("tyro.cli", cli):
        try:
            getattr(import_module(f"unmix_plugin.commands.{module}"), function)(words)
        except _Found as found:
            return found.parser, found.words
    raise RuntimeError(f"{command} {' '.join(words)} reads no arguments")


def _write_command(folder: Path, command: str) -> tuple[str, str]:
    """Writes the page of a command; its name, and what it does."""
    _, _, starts = COMMANDS[command]
    parts, first = [f"# {command}", ""], ""
    for start in starts:
        asked = ["--help-all"] if command == "unmix-train" else []
        words = [start, *asked] if start else []
        parser, _ = parser_of(command, words)
        if start:
            parts += [f"## {command} {start}", ""]
        parts += list(_description(parser))
        first = first or parts[-2].split("\n")[0]
        parts += list(_flags(parser))
        for action in parser._actions:
            if isinstance(action.choices, dict):  # those of a subcommand, whichever argparse tyro builds on
                for name, product in action.choices.items():
                    parts += [f"## {command} {name}", "", *_description(product), *_flags(product)]
    _write(folder / f"{command}.md", "\n".join(parts) + "\n")
    return command, "Train a method on a scene, or go on with a run." if command == "unmix-train" else first


def _description(parser: argparse.ArgumentParser) -> Iterator[str]:
    yield (
        (parser.description or "")
        .replace("--help-all lists all options, also those of the viewer.", "")
        .strip()
    )
    yield ""


def _flags(parser: Any) -> Iterator[str]:
    """The arguments of a parser as a list of definitions, group by group."""
    group = ""
    for action in parser._actions:
        if isinstance(action.choices, dict) or "--help" in action.option_strings:
            continue
        title = getattr(action.container, "title", "") or ""
        if title != group and title not in ("options", "positional arguments"):
            group = title
            about = (action.container.description or "").strip()
            yield from (f"**{title.removesuffix(' options')}**: {about}", "")
        yield from _flag(action)


def _flag(action: argparse.Action) -> Iterator[str]:
    names = [name for name in action.option_strings if name.startswith("--")]
    value = _value(action.metavar)
    said = re.fullmatch(r"(.*?)\s*(?:\(default: ?(.*)\)|\(required\))?", action.help or "", re.S)
    assert said is not None  # it takes any text
    help_text, default = said.groups()
    required = (action.help or "").rstrip().endswith("(required)")
    head = f"`{names[0]} {value}`".replace(" `", "`") if names else f"`{value}`"
    ending = "required" if required else "" if default in (None, "", "None") else f"default `{default}`"
    if len(names) > 1:
        ending = "; ".join(
            part for part in (ending, "in full " + ", ".join(f"`{name}`" for name in names[1:])) if part
        )
    yield head
    yield f": {' '.join(help_text.split())}" + (f" *({ending})*" if ending else "")
    yield ""


def _value(metavar: str | tuple[str, ...] | None) -> str:
    if metavar is None:
        return ""
    text = metavar if isinstance(metavar, str) else " ".join(metavar)
    text = text.replace("{None}|", "")
    return re.sub(r"\[(\S+) \[\1 \.\.\.\]\]", r"\1 ...", text)


def _commands_index(names: list[tuple[str, str]]) -> str:
    head = [
        "# Commands",
        "",
        "Every command takes `--help`, and `--debug`, which shows the traceback of an error.",
        "",
        "| command | |",
        "|---|---|",
    ]
    rows = [f"| [{name}]({name}.md) | {what} |" for name, what in names]
    return "\n".join([*head, *rows, "", _toctree("", [name for name, _ in names])])


if __name__ == "__main__":
    main()
