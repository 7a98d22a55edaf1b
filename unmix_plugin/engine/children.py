"""Processes of ours that run our code: `child_command` gives the command line, this file is what it starts.

`python -m` and `python -c` put the working directory before everything else, so that a `json.py` in a folder of
somebody's captures would run. A script puts its own folder there, which this one takes away before it imports anything;
`-P`, which does the same, is there from Python 3.11 on. What users have in PYTHONPATH stays.
"""

import sys

if __name__ == "__main__" and not getattr(sys.flags, "safe_path", False):
    del sys.path[0]  # the folder of this file, whose names are not meant to be imported by themselves

import signal

# Until the module looks after signals, Ctrl-C ends the process at once, as others do: there is nothing to clean up.
if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import importlib.util
import runpy
from collections.abc import Sequence
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]


def child_command(module: str, arguments: Sequence[str]) -> list[str]:
    """The command that runs a module of this package as a program, with this package whatever else is installed."""
    return [sys.executable, str(Path(__file__).resolve()), module, *arguments]


def _run() -> None:
    """Run the module that the first argument names, with the others."""
    found = importlib.util.spec_from_file_location(
        _PACKAGE.name, _PACKAGE / "__init__.py", submodule_search_locations=[str(_PACKAGE)]
    )
    assert found is not None
    assert found.loader is not None
    package = sys.modules[_PACKAGE.name] = importlib.util.module_from_spec(found)
    found.loader.exec_module(package)
    module = sys.argv[1]
    del sys.argv[1]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _run()
