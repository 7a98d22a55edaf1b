"""`unmix-export PRODUCT --run PATH`: files for others, from the run folder alone.

A product is one module in `products` and one entry in `PRODUCTS`.
"""

from __future__ import annotations

import inspect

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.products.abundances import Abundances
from unmix_plugin.products.cubes import Cubes
from unmix_plugin.products.endmembers import Endmembers
from unmix_plugin.products.mesh import Mesh
from unmix_plugin.products.metamerism import Metamerism
from unmix_plugin.products.pca import Pca
from unmix_plugin.products.point_cloud import PointCloud
from unmix_plugin.products.product import Job, Product
from unmix_plugin.products.report.report import Report
from unmix_plugin.products.segmentation import Segmentation
from unmix_plugin.products.spectrum import Spectrum
from unmix_plugin.products.volume import Volume

PRODUCTS: tuple[Product, ...] = (
    Abundances(),
    Cubes(),
    Endmembers(),
    Mesh(),
    Metamerism(),
    Pca(),
    PointCloud(),
    Report(),
    Segmentation(),
    Spectrum(),
    Volume(),
)
"""All there is, with the defaults of its options."""

_IN_THE_RUNS_BANDS = ("metamerism", "report", "spectrum")
"""Products that compare with spectra and lights known in the run's own bands, and that no sensor can come between."""


def export(argv: list[str]) -> None:
    """Parse the arguments, write the product, list its files.

    Raises:
        RunError: the run is unusable, or the folder can't be written.
        ConfigError: files would be overwritten, options that don't fit the run or each other, the method does not unmix
            spectra, or the device is not there.
        SpectrumError: a spectrum or a light that is unknown or does not cover the bands, or a sensor that sees nothing
            in them.
    """
    choices = tyro.extras.subcommand_type_from_defaults(
        {product.name: product for product in PRODUCTS},
        {product.name: inspect.getdoc(product) or "" for product in PRODUCTS},
    )
    product: Product = tyro.cli(
        choices, prog="unmix-export", description="Write products of a run as files.", args=argv
    )
    job = _open(product)
    written = product.write(job)
    for file in written:
        print(file)
    print(f"{len(written)} files written to {job.folder}")


def _open(product: Product) -> Job:
    """Load the run that a product is of."""
    from functools import partial

    from unmix_plugin.commands.reporting import CommandConsole, follow, say, working
    from unmix_plugin.commands.run_choice import chosen_run
    from unmix_plugin.editing.edited_run import load_edited_run

    _refuse_sensor(product)
    console = CommandConsole()
    path = chosen_run(product.run, product.output_dir)
    with working(console, f"reading {path}"):
        loaded = load_edited_run(path, product.device, product.edits, product.illuminant, product.sensor)
    folder = (product.output or loaded.folder.exports / product.name).resolve()
    for line in loaded.scene.notes:
        say(console, line)
    return Job(
        loaded,
        folder,
        product.overwrite,
        partial(say, console),
        partial(working, console),
        partial(follow, console),
    )


def _refuse_sensor(product: Product) -> None:
    """Refuse a sensor where it would mix bands."""
    from unmix_plugin.errors import ConfigError

    if product.sensor is not None and product.name in _IN_THE_RUNS_BANDS:
        able = ", ".join(one.name for one in PRODUCTS if one.name not in _IN_THE_RUNS_BANDS)
        raise ConfigError(
            f"{product.name} compares with what is known in the run's own bands and can't be seen through another "
            f"sensor; leave out --sensor. It goes with {able}"
        )


def main() -> None:
    """Console script."""
    run_command(export)
