"""What every test and every doctest runs under: one thread, no display, slow first calls allowed, numpy's own print."""

import gc
import os
import signal

import matplotlib as mpl
import numpy as np
import pytest
import torch
from hypothesis import settings

os.environ.setdefault("OMP_NUM_THREADS", "1")  # for commands that tests start as processes of their own
torch.set_num_threads(1)  # tensors in tests are tiny, and results should not depend on the machine
mpl.use("Agg")
# A shell that starts the tests in the background, or nohup, leaves signals ignored that tests send.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
# A first call may compile a kernel. Cases are the same each time, but in `make test-random`.
settings.register_profile("unmix", deadline=None, derandomize=True)
settings.register_profile("random", deadline=None, derandomize=False, max_examples=300, print_blob=True)
settings.load_profile("random" if os.environ.get("UNMIX_RANDOM_CASES") else "unmix")


@pytest.fixture(autouse=True)
def default_numpy_print():
    """Importing colour-science sets numpy's print to that of 1.13, which would change what doctests show."""
    with np.printoptions(legacy=False):
        yield


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """What is imported lives to the end: Python need not look for garbage in it, half a second each time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
        # The module of the console scripts, imported for its doctests, lets Ctrl-C end its process at once.
        signal.signal(signal.SIGINT, signal.default_int_handler)
