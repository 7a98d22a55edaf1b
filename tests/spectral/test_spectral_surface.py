import pkgutil
import subprocess
import sys
from types import ModuleType

import unmix_plugin.spectral as spectral


def test_everything_promised_is_there_and_documented():
    assert sorted(set(spectral.__all__)) == sorted(spectral.__all__)
    for name in spectral.__all__:
        assert getattr(spectral, name).__doc__ or name == "EndmemberMethod"


def test_everything_public_is_promised_and_no_name_hides_a_module():
    public = {
        name for name, value in vars(spectral).items() if name[0] != "_" and not isinstance(value, ModuleType)
    }
    assert public == set(spectral.__all__)
    modules = {module.name for module in pkgutil.iter_modules(spectral.__path__)}
    assert modules.isdisjoint(spectral.__all__)


def test_importing_the_package_imports_no_heavy_library():
    code = (
        "import sys, unmix_plugin.spectral;"
        "print([name for name in ('colour', 'scipy', 'skimage', 'matplotlib', 'warp') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_colour_science_leaves_numpy_printing_as_it_was():
    code = (
        "import numpy as np; before = np.get_printoptions();"
        "from unmix_plugin.spectral import Bands, rgb_matrix; rgb_matrix(Bands.of([450, 550, 650]));"
        "import sys; print('colour' in sys.modules, np.get_printoptions() == before)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "True True"
