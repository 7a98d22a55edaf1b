"""What makes objects of two materials, or made of a run of small pictures, quick to start from."""

import pytest

from unmix_plugin.neumatex.fit import data_manager, start
from unmix_plugin.trained import surface_mesh


@pytest.fixture(scope="module", autouse=True)
def few_pixels():
    """Of them a start needs few pixels, and a surface few rays."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(data_manager, "_NUM_PIXELS", 2000)
        patch.setattr(start, "_POINTS", 512)
        patch.setattr(surface_mesh, "_NUM_RAYS", 20_000)
        yield
