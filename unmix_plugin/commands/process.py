"""`unmix-process LAYOUT --data PATH --output-dir DIR`: from what an instrument wrote to a scene to train on.

`unmix-process inspect FILE...` says what files hold.
"""

from __future__ import annotations

from functools import partial

from unmix_plugin.engine.printing import tell


def process(arguments: list[str]) -> None:
    """Parse the arguments, make the scene, say where it is."""
    if arguments[:1] == ["inspect"]:
        from unmix_plugin.commands.process_inspect import inspect_command

        if status := inspect_command(arguments[1:]):
            raise SystemExit(status)
        return
    import tyro

    from unmix_plugin.captures.options import ProcessOptions

    options = tyro.cli(ProcessOptions, prog="unmix-process", args=arguments)

    from unmix_plugin.captures.process import process_capture
    from unmix_plugin.commands.reporting import CommandConsole, follow, say

    console = CommandConsole()
    for finding in process_capture(options, partial(say, console), partial(follow, console)):
        tell(f"looks wrong: {finding}")
    tell(f"scene: {options.output_dir}")
