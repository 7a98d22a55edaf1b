"""`unmix-process --help` is quick, as nothing heavy is imported for it."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("torch", "scipy", "matplotlib", "h5py", "tifffile", "skimage", "PIL", "pycolmap")
SCRIPT = f"""
import sys
from unmix_plugin.commands.process import main
try:
    main()
finally:
    print("imported:", *(name for name in {HEAVY} if name in sys.modules))
"""


def test_help_imports_nothing_heavy():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, "--help"], capture_output=True, text=True, timeout=300, check=True
    )
    assert "--white-rectangle" in done.stdout
    assert "imported:\n" in done.stdout
