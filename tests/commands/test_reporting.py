"""What commands say while they work."""

import io
import time

import pytest
from rich.console import Console

from unmix_plugin.commands.reporting import saying_when_kernels_compile
from unmix_plugin.rendering.launching import warp


@pytest.mark.parametrize("compiles", [True, False])
def test_compiling_is_said_only_when_a_kernel_is_not_in_the_cache(tmp_path, monkeypatch, compiles):
    (tmp_path / "wp_module_known").mkdir()
    monkeypatch.setattr(warp().config, "kernel_cache_dir", str(tmp_path))
    out, until = io.StringIO(), time.monotonic() + 20
    with saying_when_kernels_compile(Console(file=out)):
        if compiles:
            (tmp_path / "wp_module_new").mkdir()
            while not out.getvalue() and time.monotonic() < until:
                time.sleep(0.01)
    assert out.getvalue().count("compiling kernels") == compiles
