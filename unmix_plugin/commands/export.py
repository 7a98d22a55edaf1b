"""`unmix-export PRODUCT --run PATH`: files for others, from the run folder alone.

A product is one module in `commands/products` and one entry in `PRODUCTS`.
"""

from __future__ import annotations

import inspect

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.commands.products.abundances import Abundances
from unmix_plugin.commands.products.cubes import Cubes
from unmix_plugin.commands.products.endmembers import Endmembers
from unmix_plugin.commands.products.mesh import Mesh
from unmix_plugin.commands.products.metamerism import Metamerism
from unmix_plugin.commands.products.pca import Pca
from unmix_plugin.commands.products.point_cloud import PointCloud
from unmix_plugin.commands.products.product import Job, Product
from unmix_plugin.commands.products.report import Report
from unmix_plugin.commands.products.segmentation import Segmentation
from unmix_plugin.commands.products.spectrum import Spectrum
from unmix_plugin.commands.products.volume import Volume

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


def export(words: list[str]) -> None:
    """Parse the words, write the product, say what is where.

    Raises:
        RunError: the run is unusable, or the folder can't be written.
        ConfigError: files would be overwritten, options that don't fit the run or each other, the method does not unmix
            spectra, or the device is not there.
        SpectrumError: a spectrum or a light that is unknown or does not cover the bands.
    """
    choices = tyro.extras.subcommand_type_from_defaults(
        {product.name: product for product in PRODUCTS},
        {product.name: inspect.getdoc(product) or "" for product in PRODUCTS},
    )
    product: Product = tyro.cli(
        choices, prog="unmix-export", description="Write products of a run as files.", args=words
    )
    job = _open(product)
    written = product.write(job)
    for file in written:
        print(file)
    print(f"{len(written)} files written to {job.folder}")


def _open(product: Product) -> Job:
    """Load the run that a product is of."""
    from rich.console import Console

    from unmix_plugin.commands.reporting import say, working
    from unmix_plugin.commands.run_choice import chosen_run
    from unmix_plugin.exports.edited_run import light_note, load_edited_model

    console = Console()
    path = chosen_run(product.run, product.output_dir)
    with working(console, f"reading {path}"):
        loaded = load_edited_model(path, product.device, product.edits, product.illuminant)
    folder = (product.output or loaded.run.exports / product.name).resolve()
    note = light_note(loaded, product.edits, product.illuminant)
    if note is not None:
        say(console, note)
    return Job(loaded, folder, product.overwrite, console)


def main() -> None:
    """Console script."""
    run_command(export)
