"""Exit codes and error messages, shared by all commands."""

import errno
import os
import signal
import subprocess
import sys
import warnings
from contextlib import suppress
from typing import Any

import pytest
import torch

from tests.factories.commands import run
from tests.factories.systems import SIGNALS_TO_END, needs_posix
from unmix_plugin.commands.entry import run_command
from unmix_plugin.errors import ConfigError, SceneError, UnmixWarning


def end_of(command, arguments=()):
    """The exit code that a command leaves the process with."""
    with pytest.raises(SystemExit) as stop:
        run_command(command, arguments)
    return stop.value.code


def raising(error):
    def command(_words):
        raise error

    return command


def test_a_command_gets_its_words_without_debug_and_exits_0(monkeypatch, capsys):
    seen = []
    assert end_of(seen.extend, ["--data", "demo", "--debug", "7"]) == 0
    monkeypatch.setattr("sys.argv", ["unmix-train", "unmix-nerf"])
    assert end_of(seen.extend, None) == 0
    assert seen == ["--data", "demo", "7", "unmix-nerf"]
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "command",
    [
        "lambda _: print('line')",
        "lambda _: [print('line') for _ in range(100_000)]",
        "lambda _: [say(CommandConsole(), 'line') for _ in range(10)]",
    ],
)
def test_output_that_nobody_reads_to_the_end_is_no_error(command):
    """As after `| head -1`, whether all of it waits in the buffer or not."""
    code = (
        "from unmix_plugin.commands.entry import run_command; "
        f"from unmix_plugin.commands.reporting import CommandConsole, say; run_command({command}, [])"
    )
    process: Any
    words = [sys.executable, "-c", code]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


@pytest.mark.parametrize("number", SIGNALS_TO_END)
def test_a_signal_to_end_cleans_up_first(number):
    cleaned = []

    def command(_argv):
        try:
            signal.raise_signal(number)
        finally:
            cleaned.append(True)

    before = signal.signal(number, signal.SIG_DFL)
    try:
        assert end_of(command) == {"SIGTERM": 143, "SIGHUP": 129}[number.name]
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)
    assert cleaned == [True]


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        MemoryError("Unable to allocate 8.00 TiB for an array with shape (1099511627776,)"),
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB."),
        RuntimeError("[alloc_cpu.cpp:121] DefaultCPUAllocator: can't allocate memory: you tried"),
        RuntimeError("Failed to allocate 400 bytes on device 'cuda:0'"),
    ],
)
def test_too_little_memory_is_the_users_error_with_what_to_do(capsys, error):
    assert end_of(raising(error)) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("error: out of memory: ")
    assert "fewer, smaller" in shown


def test_a_home_folder_that_the_shell_left_to_us_is_meant(monkeypatch):
    seen = []
    monkeypatch.setenv("HOME", "/home/me")
    monkeypatch.setenv("USERPROFILE", "/home/me")
    given = ["--data=~/a b", "~/c", "~", "a~/b", "--x=a=~/b", "~b", "index:r1/~"]
    assert end_of(seen.extend, given) == 0
    assert seen == ["--data=/home/me/a b", "/home/me/c", "/home/me", *given[3:]]


def test_a_message_moves_no_cursor(capsys):
    assert end_of(raising(SceneError("band \x1b[31mred\r\x9b1A\tof\na.hdr: grün"))) == 2
    assert capsys.readouterr().err == "error: band ?[31mred??1A\tof\na.hdr: grün\n"


@pytest.mark.filterwarnings("default")
def test_a_warning_is_a_line(capsys):
    assert end_of(lambda _: warnings.warn("an older one is shown", UnmixWarning, stacklevel=1)) == 0
    assert capsys.readouterr().err == "warning: an older one is shown\n"


def test_a_users_error_exits_2_with_its_message_alone_or_with_debug_its_traceback(capsys):
    assert end_of(raising(SceneError("no such file"))) == 2
    assert capsys.readouterr().err == "error: no such file\n"
    assert end_of(raising(ConfigError("no such method")), ["--debug"]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("Traceback")
    assert shown.endswith("error: no such method\n")


@pytest.mark.parametrize("error", [ZeroDivisionError("division by zero"), BrokenPipeError("ffmpeg")])
def test_anything_else_exits_1_and_is_called_a_bug_in_one_line(capsys, error):
    assert end_of(raising(error)) == 1
    shown = capsys.readouterr().err
    assert shown.startswith("this is a bug")
    assert shown.endswith(f": {type(error).__name__}: {error}\n")
    assert shown.count("\n") == 1


def test_an_interrupt_that_an_import_loses_is_still_one(capsys):
    def command(_words):
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        raise AttributeError("module 'numpy' has no attribute 'matrix'")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert end_of(command) == 130
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize("script", ["train", "export", "demo_scene"])
def test_an_interrupt_while_a_command_is_imported_is_no_traceback(script):
    """As when somebody notices a wrong word right after Enter."""
    code = (
        "import signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'tyro':\n"
        "            signal.raise_signal(signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        f"from unmix_plugin.commands import scripts; scripts.{script}()"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (130, "interrupted\n")


@pytest.mark.parametrize(
    ("stop", "status", "said"),
    [(SystemExit(0), 0, ""), (SystemExit(2), 2, ""), (KeyboardInterrupt(), 130, "interrupted\n")],
)
def test_the_parsers_own_exit_and_an_interrupt_pass_through(capsys, stop, status, said):
    assert end_of(raising(stop)) == status
    assert capsys.readouterr().err == said


def as_process(command, *, redirect="", **environment):
    """A command in a process of its own, with the streams that a shell gives it."""
    code = f"from unmix_plugin.commands.entry import run_command; run_command({command}, [])"
    words = ["sh", "-c", f'exec "$0" -c "$1" {redirect}', sys.executable, code]
    return subprocess.run(words, capture_output=True, env={**os.environ, **environment}, check=False)


@needs_posix
@pytest.mark.parametrize("redirect", [">&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_change_no_exit_code(redirect):
    assert as_process("lambda _: print('line')", redirect=redirect).returncode == 0
    numbers = (
        "lambda _: [__import__('os').fstat(number) for number in range(3)]"  # native code writes to them
    )
    assert as_process(numbers, redirect=redirect).returncode == 0
    failing = "lambda _: (_ for _ in ()).throw(__import__('unmix_plugin.errors').errors.SceneError('none'))"
    assert as_process(failing, redirect=redirect).returncode == 2


@needs_posix
def test_text_that_a_stream_has_no_letters_for_is_written_in_another_way():
    ended = as_process("lambda _: print('\u00b5m', '\\udcff')", PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert (ended.returncode, ended.stdout) == (0, b"\\xb5m \xff\n"), ended.stderr


@pytest.mark.parametrize("number", [errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EIO, errno.ENOSPC])
def test_what_the_system_says_of_names_and_disks_is_for_the_user_to_mend(number, capsys):
    assert end_of(raising(OSError(number, os.strerror(number), "some/file"))) == 2
    assert "some/file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "words", "heavy"),
    [
        ("train", ["unmix-nerf", "--help-all"], "torch colour tensorboard"),
        ("export", ["mesh", "--help"], "torch warp"),
    ],
)
def test_help_imports_nothing_that_it_does_not_need(command, words, heavy):
    code = (
        "import sys\nfrom unmix_plugin.commands.entry import run_command\n"
        f"from unmix_plugin.commands.{command} import {command} as command\n"
        f"for words in [{words[:-1]} + ['--help'], {words}]:\n"
        "    try:\n        run_command(command, words)\n"
        "    except SystemExit as stop:\n"
        f"        heavy = 'scipy skimage matplotlib PIL {heavy}'.split()\n"
        "        print('end:', stop.code, [name for name in heavy if name in sys.modules])\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    first, second, rest = ended.stdout.split(b"end: 0 []\n")
    assert min(len(first), len(second)) > 200
    assert rest == b""


@needs_posix
def test_pipes_and_devices_are_refused_before_anything_waits_for_them(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for words in ([tmp_path / "pipe"], [f"--mask={tmp_path / 'pipe'}"], ["--data", "/dev/zero"]):
        ended = run(lambda _: None, *words)
        assert ended.status == 2
        assert "is a pipe, a socket or a device; give a regular file" in ended.err


def test_what_a_full_device_or_a_limit_refuses_is_said_with_place_and_advice():
    def fail(error):
        def command(_):
            raise error

        return run(command)

    ended = fail(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert ended.status == 2
    assert "standard output, or a file that was open: No space left on device; make room" in ended.err
    ended = fail(OSError(errno.EFBIG, os.strerror(errno.EFBIG), "out.bin"))
    assert "out.bin: File too large; raise the limit" in ended.err
    for error in (
        ImportError("libtorch.so: failed to map segment from shared object"),
        RuntimeError("can't start new thread"),
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
    ):
        ended = fail(error)
        assert (ended.status, ended.err.startswith("error: out of memory")) == (2, True)
