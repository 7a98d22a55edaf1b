"""`unmix-export PRODUCT --run PATH`: files for others, from the run folder alone.

A product is one module in `products` and its options in `products/scene_products.py`, or is brought along by a method
(`MethodSpecification.products`).
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

import tyro

from unmix_plugin.commands.entry import run_command
from unmix_plugin.engine.printing import tell
from unmix_plugin.engine.registry import BrokenPlugin, discover_methods
from unmix_plugin.errors import ConfigError, counted
from unmix_plugin.products.product import Job, Product, RunProduct, RunWork, ViewProduct
from unmix_plugin.products.scene_products import PRODUCTS

if TYPE_CHECKING:
    from unmix_plugin.engine.processes import Processes


def _own_products(taken: Collection[str]) -> tuple[dict[str, _OwnProduct], list[BrokenPlugin]]:
    """What methods bring, by the product's name, and what had to be skipped: names in `taken` are others' already."""
    methods, _ = discover_methods()
    found: dict[str, _OwnProduct] = {}
    broken: list[BrokenPlugin] = []
    for method_name, method in methods.items():
        # A third party's module may fail in any way at all; the products of others stay.
        try:
            products = () if method.products is None else tuple(method.products())
        except Exception as error:  # noqa: BLE001
            lines = str(error).strip().splitlines() or ["no message"]
            broken.append(BrokenPlugin(method_name, f"its products: {type(error).__name__}: {lines[0]}"))
            continue
        for product in products:
            known = found.get(product.name, _OwnProduct(product, ()))
            if product.name in taken or known.product != product:
                reason = f"another product has the name {product.name} already"
                broken.append(BrokenPlugin(method_name, reason))
            else:
                found[product.name] = _OwnProduct(product, (*known.methods, method_name))
    return found, broken


class _OwnProduct(NamedTuple):
    """A product that only some methods have, with the defaults of its options, and the names of these methods."""

    product: RunProduct
    methods: tuple[str, ...]


_IN_THE_RUNS_BANDS = ("metamerism", "report", "spectrum")
"""Products that compare with spectra and lights known in the run's own bands, and that no sensor can come between."""


def export(argv: list[str]) -> None:
    """Parse the arguments, write the product, list its files."""
    own, broken = _own_products({product.name for product in PRODUCTS})
    for plugin in broken:
        tell(plugin, file=sys.stderr)
    offered = sorted((*PRODUCTS, *(one.product for one in own.values())), key=lambda one: one.name)
    choices = tyro.extras.subcommand_type_from_defaults(
        {product.name: product for product in offered},
        {product.name: inspect.getdoc(product) or "" for product in offered},
    )
    about = "Write products of a run as files."
    product: RunWork = tyro.cli(choices, prog="unmix-export", description=about, args=argv)

    from unmix_plugin.engine.processes import joined, start_together

    count = product.num_devices if isinstance(product, ViewProduct) else 1
    start_together("unmix_plugin.commands.export", argv, count)
    with joined(product.device) as processes:
        write_product(product, own, processes)


def write_product(product: RunWork, own: dict[str, _OwnProduct], processes: Processes) -> None:
    if not isinstance(product, ViewProduct) and processes.count > 1:
        raise ConfigError(f"unmix-export {product.name} runs in one process; start it once")
    with processes.together():
        job = _open(product, own, processes)
    written = product.write(job)
    if not processes.is_first:
        return
    for file in written:
        tell(file)
    if written:
        folder = job.folder if written[0].is_relative_to(job.folder) else written[0].parent
        tell(f"{counted(len(written), 'file')} written to {folder}")


def _open(product: RunWork, own: dict[str, _OwnProduct], processes: Processes) -> Job:
    """Load the run that a product is of."""
    from functools import partial

    from unmix_plugin.commands.reporting import CommandConsole, chosen_run, follow, say, working
    from unmix_plugin.editing.edited_run import load_edited_run
    from unmix_plugin.trained.open_run import load_run

    if isinstance(product, Product) and product.sensor is not None and product.name in _IN_THE_RUNS_BANDS:
        able = [
            one.name for one in PRODUCTS if isinstance(one, Product) and one.name not in _IN_THE_RUNS_BANDS
        ]
        raise ConfigError(
            f"{product.name} compares with what is known in the run's own bands and can't be seen through another "
            f"sensor; leave out --sensor. It goes with {', '.join(able)}"
        )
    console = CommandConsole(quiet=not processes.is_first)
    path = chosen_run(product.run, product.output_dir)
    with working(console, f"reading {path}"):
        if isinstance(product, Product):
            loaded = load_edited_run(path, product.device, product.edits, product.illuminant, product.sensor)
        else:
            loaded = load_run(path, product.device)
    method, methods = loaded.config.method_name, own[product.name].methods if product.name in own else None
    if methods is not None and method not in methods:
        raise ConfigError(
            f"the method {method} has no product {product.name}: it needs a run of {' or '.join(methods)}"
        )
    folder = loaded.folder.path
    if isinstance(product, RunProduct):
        folder = (product.output or folder.joinpath("exports", product.name)).resolve()
    for line in loaded.scene.notes:
        say(console, line)
    return Job(
        loaded,
        folder,
        isinstance(product, RunProduct) and product.overwrite,
        partial(say, console),
        partial(working, console),
        partial(follow, console),
        processes,
    )


if __name__ == "__main__":  # of one of several processes
    run_command(export)
