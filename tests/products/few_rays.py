"""Surfaces and pages of tiny scenes, for which few rays are enough."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def few_rays(num_rays: int) -> Iterator[None]:
    """Context in which a surface is looked at with so many rays, and pages have small pictures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("unmix_plugin.trained.surface_mesh._NUM_RAYS", num_rays)
        patch.setattr("unmix_plugin.products.page.page._PICTURE_PX", 48)
        yield
