"""`unmix-demo-scene DIR`: write the built-in scene as a folder of any size."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.scenes.demo.materials import LAMP
from unmix_plugin.scenes.demo.scene import DEFAULT_BANDS, DEFAULT_SIZE, DEFAULT_VIEWS, make_demo_scene
from unmix_plugin.spectral.colour.illuminants import parse_light


@dataclass(frozen=True)
class DemoSceneOptions:
    """Write a small ray-traced scene with true labels, abundances and endmembers."""

    directory: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder to write; made if it is not there."""
    size: int = DEFAULT_SIZE
    """Width and height of every image, pixels."""
    bands: int = DEFAULT_BANDS
    """Bands, evenly spaced over 400-700 nm."""
    views: int = DEFAULT_VIEWS
    """Images on a dome; every 4th is for evaluation."""
    illuminant: str = LAMP
    """What lights the scene: a CIE illuminant (D50, D65, A, E, FL2, ...) or a .csv file (wavelength,power)."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Accept a folder that is not empty: a demo scene in it is replaced, other files stay."""


def write_demo_scene(arguments: list[str]) -> None:
    """Parse the arguments, write the scene, say what is where."""
    options = tyro.cli(DemoSceneOptions, prog="unmix-demo-scene", args=arguments)
    started = time.perf_counter()
    light = parse_light(options.illuminant)
    make_demo_scene(options.directory, options.size, options.bands, options.views, options.overwrite, light)
    seconds = time.perf_counter() - started
    evaluation = len(list((options.directory / "abundances").glob("eval_*")))
    print(
        f"{options.directory}: {options.views} views ({options.views - evaluation} to train on, {evaluation} for "
        f"evaluation) of {options.size} x {options.size} pixels and {options.bands} bands, in {seconds:.1f} s"
    )
    print(f"  {options.directory / 'transforms.json'}  cameras, wavelengths, splits")
    for name, content in (
        ("cubes", "radiance in [0, 1], float16 (H, W, B)"),
        ("images", "sRGB with alpha"),
        ("labels", "true material of each pixel, 255 where there is none"),
        ("abundances", "true abundances of evaluation views, float16 (H, W, K)"),
        ("endmembers.csv", "true reflectances"),
        ("illuminant.csv", "the lamp's spectrum"),
    ):
        print(f"  {options.directory / name}  {content}")
    print(f"train on it: unmix-train unmix-nerf --data {options.directory}")


def main() -> None:
    """Console script."""
    run_command(write_demo_scene)
