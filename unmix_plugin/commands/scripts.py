"""The console scripts. They import their commands, which takes seconds, where Ctrl-C is already looked after."""

from importlib import import_module
from typing import NoReturn

from unmix_plugin.commands.entry import run_command


def train() -> NoReturn:
    """`unmix-train`."""
    _run("train", "train")


def evaluate() -> NoReturn:
    """`unmix-eval`."""
    _run("eval", "evaluate")


def export() -> NoReturn:
    """`unmix-export`."""
    _run("export", "export")


def image() -> NoReturn:
    """`unmix-image`."""
    _run("image", "image")


def process() -> NoReturn:
    """`unmix-process`."""
    _run("process", "process")


def render() -> NoReturn:
    """`unmix-render`."""
    _run("render", "render")


def demo() -> NoReturn:
    """`unmix-demo`."""
    _run("demo", "demo")


def demo_scene() -> NoReturn:
    """`unmix-demo-scene`."""
    _run("demo_scene", "write_demo_scene")


def view() -> NoReturn:
    """`unmix-view`."""
    _run("view", "view")


def _run(module: str, command: str) -> NoReturn:
    run_command(lambda words: getattr(import_module(f"unmix_plugin.commands.{module}"), command)(words))
