"""Products that methods bring along: `MethodSpecification.products`."""

from __future__ import annotations

from dataclasses import dataclass

from unmix_plugin.engine.registry import BrokenPlugin, discover_methods
from unmix_plugin.errors import ConfigError
from unmix_plugin.products.product import RunProduct


@dataclass(frozen=True)
class OwnProduct:
    """A product that only some methods have."""

    product: RunProduct
    """With the defaults of its options."""
    methods: tuple[str, ...]
    """Names of the methods that bring it."""

    def require(self, method_name: str) -> None:
        """Refuse a run of another method.

        Raises:
            ConfigError: the product is none of this method's.
        """
        if method_name not in self.methods:
            raise ConfigError(
                f"the method {method_name} has no product {self.product.name}: it needs a run of "
                f"{' or '.join(self.methods)}"
            )


def own_products(taken: frozenset[str]) -> tuple[dict[str, OwnProduct], list[BrokenPlugin]]:
    """What methods bring, by the product's name, and what had to be skipped.

    Args:
        taken: Names of products that are there already.
    """
    methods, _ = discover_methods()
    found: dict[str, OwnProduct] = {}
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
            known = found.get(product.name)
            if product.name in taken or (known is not None and known.product != product):
                reason = f"another product has the name {product.name} already"
                broken.append(BrokenPlugin(method_name, reason))
                continue
            found[product.name] = OwnProduct(product, (*(known.methods if known else ()), method_name))
    return found, broken
