"""`unmix-demo`: does it work here, what comes out? Train on the built-in scene, evaluate, export maps and a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from unmix_plugin.engine.configs import DeviceName
from unmix_plugin.engine.printing import tell


@dataclass(frozen=True)
class _DemoOptions:
    """Train on the built-in scene, evaluate the run, export abundance maps and a page in 3-D, say where they are."""

    seconds: float = 45.0
    """Time to train."""
    output_dir: Path = Path("outputs")
    """Folder for the run."""
    device: DeviceName = "auto"
    """Where to compute; auto takes CUDA where there is one."""


def demo(arguments: list[str]) -> None:
    """Parse the arguments, do what the commands do, say what to look at."""
    options = tyro.cli(_DemoOptions, prog="unmix-demo", args=arguments)

    from unmix_plugin.commands.eval import evaluate
    from unmix_plugin.commands.export import export
    from unmix_plugin.commands.reporting import shell_line
    from unmix_plugin.commands.train import train
    from unmix_plugin.engine.runs.run_folder import newest_run

    device = ["--device", options.device]
    demo_words = ["--data", "demo", "--max-seconds", str(options.seconds), "--endmembers", "6"]
    train(["unmix-nerf", *demo_words, "--output-dir", str(options.output_dir), *device])
    run = newest_run(options.output_dir)
    words = ["--run", str(run.path), *device]
    evaluate(words)
    export(["abundances", *words])
    export(["page", *words, "--resolution", "160"])
    tell(f"\npictures: {run.eval} (true, predicted, error) and {run.exports} (abundance maps)")
    tell(f"in 3-D, to open in a browser or to mail: {run.exports / 'page' / 'page.html'}")
    tell(f"look around in it: {shell_line('unmix-view', '--run', run.path)}")
