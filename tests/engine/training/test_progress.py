"""Progress is a live bar on a terminal and plain lines elsewhere."""

import io
import re
from dataclasses import replace

import pytest
from rich.console import Console

from unmix_plugin.engine.configs import TrainerConfig
from unmix_plugin.engine.training.progress import ProgressConsole, ProgressDisplay, TrainingStatus
from unmix_plugin.engine.training.trainer import Trainer
from unmix_plugin.engine.training.training_control import Interrupted

STATUS = TrainingStatus(
    step=120, seconds=30.0, progress=0.25, loss=0.00123, psnr=31.5, rays_per_second=18_200.0
)


def test_a_status_says_step_loss_psnr_speed_and_time_left():
    assert str(STATUS) == "step 120   25 %  loss 0.00123  psnr 31.50 dB  18.2k rays/s  1:30 left"
    bare = replace(STATUS, psnr=None, progress=0.0, rays_per_second=2.4e6)
    assert str(bare) == "step 120    0 %  loss 0.00123  2.4M rays/s"
    assert str(replace(STATUS, seconds=7200.0)).endswith("6:00:00 left")


def test_where_the_output_is_no_terminal_each_status_is_one_plain_line():
    out = io.StringIO()
    display = ProgressDisplay(Console(file=out, width=40), plain_interval_s=0.0)
    with display:
        assert display.is_due
        display.show(STATUS)
        display.message("saved [bold]x[/bold]")
    assert out.getvalue() == f"{STATUS}\nsaved [bold]x[/bold]\n"


def test_a_status_is_due_only_after_the_interval():
    display = ProgressDisplay(Console(file=io.StringIO()), plain_interval_s=100.0)
    assert not display.is_due


def test_on_a_terminal_the_bar_is_redrawn_in_place_and_messages_stay_above():
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=120, color_system=None)
    with ProgressDisplay(console) as display:
        display.show(STATUS)
        display.message("a line that stays")
        display.show(replace(STATUS, step=121))
    assert "\x1b[2K" in out.getvalue()
    assert "step 121" in out.getvalue()
    assert out.getvalue().count("a line that stays") == 1


@pytest.mark.parametrize("width", [40, 60, 80, 100, 200])
def test_the_time_left_is_never_cut_off(width: int):
    out = io.StringIO()
    with ProgressDisplay(Console(file=out, force_terminal=True, width=width, color_system=None)) as display:
        display.show(STATUS)
    assert "step 120   25 %" in out.getvalue()
    assert "1:30 left" in out.getvalue()


def test_a_console_that_is_gone_ends_training_with_all_saved(short_config: TrainerConfig, monkeypatch):
    class Gone(io.StringIO):
        def write(self, _: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr(ProgressDisplay, "is_due", property(lambda self: not self.is_closed))
    trainer = Trainer(short_config, console=ProgressConsole(file=Gone()))
    with pytest.raises(Interrupted) as stopped:
        trainer.train()
    assert stopped.value.step == 1
    assert "its output is closed" in trainer.run.log_path.read_text()


def test_training_off_a_terminal_prints_lines_without_control_codes(short_config: TrainerConfig, monkeypatch):
    monkeypatch.setattr(ProgressDisplay, "is_due", property(lambda _: True))
    out = io.StringIO()
    config = replace(short_config, steps_per_eval_all_images=6)
    Trainer(config, console=Console(file=out)).train()
    lines = out.getvalue().splitlines()
    assert len(lines) == 14
    assert "\x1b" not in out.getvalue()
    assert re.fullmatch(r"step 12  100 %  loss \S+  psnr \S+ dB  \S+ rays/s  0:00 left", lines[-2])
    assert re.fullmatch(r"step 12: evaluation views: psnr [\d.]+", lines[-1])


def test_even_the_shortest_training_shows_where_it_ended(short_config: TrainerConfig):
    out = io.StringIO()
    Trainer(short_config, console=Console(file=out)).train()
    assert [line.split("  ")[0] for line in out.getvalue().splitlines()] == ["step 12"]
