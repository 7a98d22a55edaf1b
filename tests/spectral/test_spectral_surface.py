import pkgutil
import subprocess
import sys

import unmix_plugin.spectral as spectral


def test_importing_any_module_imports_no_heavy_library():
    modules = [module.name for module in pkgutil.walk_packages(spectral.__path__, "unmix_plugin.spectral.")]
    assert len(modules) > 20
    code = (
        f"import sys, importlib; [importlib.import_module(name) for name in {modules}];"
        "print([name for name in ('colour', 'scipy', 'skimage', 'matplotlib', 'warp') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_colour_science_leaves_numpy_printing_as_it_was():
    code = (
        "import numpy as np; before = np.get_printoptions();"
        "from unmix_plugin.spectral.bands import Bands;"
        "from unmix_plugin.spectral.colour.conversion import rgb_matrix;"
        "rgb_matrix(Bands.of([450, 550, 650]));"
        "import sys; print('colour' in sys.modules, np.get_printoptions() == before)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "True True"
