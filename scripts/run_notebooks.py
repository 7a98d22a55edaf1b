"""Runs the notebooks of docs/tutorials in a folder of their own: `python scripts/run_notebooks.py [NAME ...]`.

Exit status 1 where a cell fails. With `--write` they are saved with what they printed and drew, which is how they are
committed; with `--seconds` their trainings are shorter and their pictures smaller. Needs: pip install '.[docs]'.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from PIL import Image

TUTORIALS = Path(__file__).resolve().parents[1] / "docs/tutorials"
_PROGRESS = re.compile(r"\s*[\u2800-\u28ff]|.*(\u2501\u2501|-:--:--| left$)|\s*starting$")
"""What a line of a spinner, a progress bar or a table's rule looks like."""
_LONGEST_OUTPUT = 24
"""Lines that are kept of what a cell prints."""


def run(name: str, seconds: float | None) -> nbformat.NotebookNode:
    """The notebook with its outputs.

    Raises:
        CellExecutionError: a cell failed.
    """
    text = (TUTORIALS / f"{name}.ipynb").read_text(encoding="utf-8")
    if seconds is not None:
        text = re.sub(r"(SECONDS = |--max-seconds )\d+", rf"\g<1>{seconds:g}", text)
        text = re.sub(r"resized\(\d+, \d+\)", "resized(48, 48)", text)
    notebook = nbformat.reads(text, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(
            TUTORIALS,
            folder,
            dirs_exist_ok=True,
            ignore=shutil.ignore_patterns("tutorial-files", "__pycache__"),
        )
        programs = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        client = NotebookClient(
            notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": folder}}
        )
        client.execute(
            env={**os.environ, "PATH": programs, "NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "100"}
        )
        for cell in notebook.cells:
            _tidy(cell, os.path.realpath(folder))
    return notebook


def _tidy(cell: nbformat.NotebookNode, folder: str) -> None:
    """Joins what a cell printed, and leaves out the folder's name, times, and long lists."""
    cell.metadata = {}
    if cell.cell_type != "code":
        return
    printed = "".join(output.text for output in cell.outputs if output.output_type == "stream")
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", printed.replace(f"{folder}/", ""))
    lines = [line.rstrip() for line in plain.splitlines()]
    lines = [line for line in lines if line and not _PROGRESS.match(line)]
    if len(lines) > _LONGEST_OUTPUT:
        lines = [*lines[: _LONGEST_OUTPUT // 2], "...", *lines[-_LONGEST_OUTPUT // 2 :]]
    stream = [nbformat.v4.new_output("stream", text="\n".join(lines) + "\n")] if lines else []
    pictures = [output for output in cell.outputs if "image/png" in output.get("data", {})]
    for output in pictures:
        output.data = {"image/png": _smaller(output.data["image/png"]), "text/plain": "a picture"}
        output.metadata = {}
    cell.outputs = stream + pictures


def _smaller(picture: str) -> str:
    """A PNG in base64, in 128 colours."""
    buffer = io.BytesIO()
    image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
    image.quantize(128, dither=Image.Dither.NONE).save(buffer, format="png", optimize=True)
    return base64.b64encode(buffer.getvalue()).decode()


def main() -> None:
    """Console entry."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=sorted(path.stem for path in TUTORIALS.glob("*.ipynb")))
    parser.add_argument("--write", action="store_true", help="save the notebooks with their outputs")
    parser.add_argument("--seconds", type=float, help="length of each training")
    given = parser.parse_args()
    for name in given.names:
        began = time.monotonic()
        try:
            notebook = run(name, given.seconds)
        except CellExecutionError as error:
            sys.exit(f"{name}: {error}")
        print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)
        if given.write:
            nbformat.write(notebook, TUTORIALS / f"{name}.ipynb")


if __name__ == "__main__":
    main()
