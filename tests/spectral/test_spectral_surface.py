import pkgutil
import subprocess
import sys

import unmix_plugin.spectral as spectral

CODE = """
import importlib, sys
import numpy as np
before = np.get_printoptions()
for name in {modules}:
    importlib.import_module(name)
print([name for name in ("colour", "scipy", "skimage", "matplotlib", "warp") if name in sys.modules])
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.colour.conversion import rgb_matrix
rgb_matrix(Bands.of([450, 550, 650]))
print("colour" in sys.modules, np.get_printoptions() == before)
"""


def test_no_module_imports_a_heavy_library_nor_do_colours_of_bands():
    modules = [module.name for module in pkgutil.walk_packages(spectral.__path__, "unmix_plugin.spectral.")]
    assert len(modules) > 20
    code = CODE.format(modules=modules)
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.splitlines() == ["[]", "False True"]
