"""Which run a command is about."""

from __future__ import annotations

from pathlib import Path

from unmix_plugin.engine.runs.run_folder import newest_run


def chosen_run(run: Path | None, output_dir: Path) -> Path:
    """The run folder named, or else the newest under `output_dir`, which is then said.

    Raises:
        RunError: none was named and there is none.
    """
    if run is not None:
        return run
    newest = newest_run(output_dir).path
    print(f"newest run: {newest}", flush=True)
    return newest
