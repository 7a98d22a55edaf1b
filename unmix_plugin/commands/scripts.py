"""The console scripts. They import their commands, which takes seconds, where signals are already looked after."""

import os
import signal

# Threads of numpy's OpenBLAS spin while they wait, as OpenMP's do: beside anything else on the machine a demo capture
# took three times as long, and alone they gain nothing, since large products are torch's. Read once, as numpy loads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Until then Ctrl-C ends the process at once, as other signals do: there is nothing to clean up.
if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

from functools import partial
from importlib import import_module
from typing import NoReturn

from unmix_plugin.commands.entry import run_command


def _run(module: str, command: str) -> NoReturn:
    run_command(lambda words: getattr(import_module(f"unmix_plugin.commands.{module}"), command)(words))


asset = partial(_run, "asset", "asset")
compare = partial(_run, "compare", "compare")
train = partial(_run, "train", "train")
evaluate = partial(_run, "eval", "evaluate")
export = partial(_run, "export", "export")
image = partial(_run, "image", "image")
process = partial(_run, "process", "process")
render = partial(_run, "render", "render")
demo = partial(_run, "demo", "demo")
demo_scene = partial(_run, "demo_scene", "write_demo_scene")
view = partial(_run, "view", "view")
