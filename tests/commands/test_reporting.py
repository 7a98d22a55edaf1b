"""What commands say while they work."""

import io
import threading

import pytest
from rich.console import Console

from unmix_plugin.commands import reporting
from unmix_plugin.commands.reporting import announce_kernel_compilation, shell_line
from unmix_plugin.operators.launching import warp


@pytest.mark.parametrize("compiles", [True, False])
def test_compiling_is_said_only_when_a_kernel_is_not_in_the_cache(tmp_path, monkeypatch, compiles):
    (tmp_path / "wp_module_known").mkdir()
    monkeypatch.setattr(warp().config, "kernel_cache_dir", str(tmp_path))
    out, is_said = io.StringIO(), threading.Event()
    monkeypatch.setattr(reporting, "say", lambda console, text: (console.print(text), is_said.set()))
    with announce_kernel_compilation(Console(file=out)):
        if compiles:
            (tmp_path / "wp_module_new").mkdir()
            assert is_said.wait(120)
    assert out.getvalue().count("compiling kernels") == compiles


@pytest.mark.parametrize(
    ("is_windows", "folder", "written"),
    [
        (False, "my run", "'my run'"),
        (True, r"C:\my run", r'"C:\my run"'),
        (True, r"C:\run", r"C:\run"),
    ],
)
def test_printed_commands_are_quoted_as_the_system_takes_them(monkeypatch, is_windows, folder, written):
    monkeypatch.setattr(reporting, "_IS_WINDOWS", is_windows)
    assert shell_line("unmix-view", "--run", folder) == f"unmix-view --run {written}"
