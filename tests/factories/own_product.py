"""The plain RGB method with a product of its own, as a third party would add one."""

from dataclasses import dataclass, replace
from pathlib import Path

from tests.factories.rgb_nerf import rgb_nerf
from unmix_plugin.engine import MethodSpecification
from unmix_plugin.formats.files import write_file
from unmix_plugin.products.product import Job, RunProduct


@dataclass(frozen=True)
class ViewNames(RunProduct):
    """Names of all views, one a line: names.txt."""

    name = "view-names"
    capitals: bool = False
    """In capital letters."""

    def write(self, job: Job) -> list[Path]:
        job.claim([job.folder / "names.txt"])
        text = "\n".join(view.name for view in job.views("all"))
        return [write_file(job.folder / "names.txt", (text.upper() if self.capitals else text).encode())]


@dataclass(frozen=True)
class Clashing(ViewNames):
    """A product whose name is taken."""

    name = "mesh"


def _broken():
    raise ImportError("no module named scissors")


def _with(products, name: str = "rgb-nerf") -> MethodSpecification:
    config = replace(rgb_nerf.config, method_name=name)
    return MethodSpecification(config, rgb_nerf.description, products=products)


with_product = _with(lambda: (ViewNames(),))
clashing = _with(lambda: (Clashing(),), "rgb-2")
broken = _with(_broken, "rgb-3")
