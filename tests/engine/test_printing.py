"""Names of strangers steer no terminal, wherever a command or a training shows them."""

import io
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.progress import Progress

from unmix_plugin.commands.reporting import CommandConsole, say
from unmix_plugin.engine.printing import tell, terminal_text
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.training.progress import ProgressConsole, write_event

HOSTILE = "grass\x1b]0;title\x07\x1b[2J\x9b31m\x7f\r\u202egnp.exe\u2066\u200f"
SHOWN = "grass?]0;title??[2J?31m???gnp.exe??"


@given(st.text())
def test_only_letters_that_steer_a_terminal_are_replaced(text):
    shown = terminal_text(text)
    assert len(shown) == len(text)
    for before, after in zip(text, shown, strict=True):
        steers = unicodedata.category(before) == "Cc" and before not in "\t\n"
        steers |= unicodedata.bidirectional(before) in (
            "LRE",
            "RLE",
            "LRO",
            "RLO",
            "PDF",
            "LRI",
            "RLI",
            "FSI",
            "PDI",
        )
        assert not steers or after == "?"
        assert after in (before, "?")


def test_names_of_other_scripts_stay():
    name = "עלה ورقة 葉 grün µm² e\u0301 👩\u200d🔬"
    assert terminal_text(name) == name


def test_a_line_is_cleaned(capsys):
    tell(HOSTILE)
    assert capsys.readouterr().out == f"{SHOWN}\n"


@pytest.mark.parametrize("kind", [CommandConsole, ProgressConsole])
@pytest.mark.parametrize("is_terminal", [False, True])
def test_a_console_cleans_what_it_prints(kind, is_terminal):
    stream = io.StringIO()
    console = kind(file=stream, force_terminal=is_terminal, color_system=None, width=200)
    say(console, HOSTILE)
    assert "\x1b]" not in stream.getvalue()
    assert "\u202e" not in stream.getvalue()
    assert "title" in stream.getvalue()


def test_a_bar_still_moves_the_cursor_of_its_terminal():
    stream = io.StringIO()
    console = CommandConsole(file=stream, force_terminal=True, color_system=None, width=200)
    with Progress(console=console, auto_refresh=False) as bar:
        bar.add_task(HOSTILE, total=1.0)
        bar.refresh()
        bar.refresh()
    assert "\x1b[2K" in stream.getvalue()
    assert "\x1b]0;" not in stream.getvalue()


def test_the_log_of_a_run_is_cleaned(tmp_path):
    run = RunFolder(tmp_path)
    write_event(run, HOSTILE)
    assert run.log_path.read_text(encoding="utf-8").endswith(f" {SHOWN}\n")
