"""How training goes, and what can be asked of it."""

from __future__ import annotations

import numpy as np

from unmix_plugin.engine.training.training_control import SHARE_BOUNDS
from unmix_plugin.viewer.page import Chart, Line, number_of, table
from unmix_plugin.viewer.session import Session

_CURVES = (("loss", "loss", (0.85, 0.3, 0.1)), ("psnr", "PSNR (dB)", (0.1, 0.4, 0.8)))
"""Names in the status, what users read, colours."""

_TICKS_A_CHART = 4


class TrainingPanel:
    """Shows and steers the training under way."""

    def __init__(self, session: Session) -> None:
        control = session.services.source.control
        assert control is not None
        self._session, self._control = session, control
        self._ticks = 0
        gui = session.client.gui
        self._state = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0)
        self._pause = session.add_button("pause", self._toggle)
        save = session.add_button("save a checkpoint", self._save_checkpoint)
        self._sure = gui.add_checkbox("really stop", False)
        stop = session.add_button("stop training", self._stop, "red")
        self._steering = (self._pause, save, self._sure, stop)
        hint = "Of the device's time, while someone moves."
        share = gui.add_slider("viewer's share", *SHARE_BOUNDS, 0.05, control.device.viewing_share, hint=hint)
        self._share = session.on_change(share, self._change_share)
        self._charts = [Chart(gui, title, "step") for _, title, _ in _CURVES]
        self._tick()
        session.on_tick.append(self._tick)

    def _tick(self) -> None:
        control, status = self._control, self._control.status
        self._pause.label = "resume" if control.is_paused else "pause"
        rows = [("training", self._condition())]
        if status is not None:
            rows += [
                ("step", f"{status.step}, {100 * status.progress:.0f} %"),
                ("loss", f"{status.loss:.4g}"),
                ("PSNR of the batch", "-" if status.psnr is None else f"{status.psnr:.2f} dB"),
            ]
        if status is not None and control.is_running:
            seconds = status.seconds_left
            rows.append(("speed", f"{status.rays_per_second / 1000:.1f} k rays/s"))
            rows.append(("time left", "-" if seconds is None else f"{seconds:.0f} s of training"))
        self._state.content = table(rows)
        for steering in self._steering:
            steering.disabled = not control.is_running
        self._bar.value = 0.0 if status is None else 100 * status.progress
        if self._ticks % _TICKS_A_CHART == 0:
            curve = self._session.services.curve
            steps = np.array([float(point.step) for point in curve])
            for chart, (name, title, colour) in zip(self._charts, _CURVES, strict=True):
                values = [getattr(point, name) for point in curve]
                lines = [] if None in values else [Line(name, np.array(values), colour)]
                chart.draw(steps, lines, title)
        self._ticks += 1

    def _condition(self) -> str:
        control = self._control
        if control.is_stop_requested:
            return "stopping" if control.is_running else "stopped, and saved"
        if not control.is_running:
            return "has not begun" if control.status is None else "done"
        return "paused" if control.is_paused else "running"

    def _toggle(self) -> None:
        if self._control.is_paused:
            self._control.resume()
        else:
            self._control.pause()
        self._tick()

    def _save_checkpoint(self) -> None:
        self._control.request_save()
        self._session.say("saving", "a checkpoint is saved after the step under way")

    def _stop(self) -> None:
        if self._sure.value is True:
            self._control.request_stop()
        else:
            self._session.say(
                "stop?", "tick the box above first: training is saved and ends, as does the viewer"
            )

    def _change_share(self) -> None:
        device = self._control.device
        device.viewing_share = number_of(self._share, device.viewing_share)
