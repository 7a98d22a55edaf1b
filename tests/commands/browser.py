"""The browser that tests drive, where there is one."""

import importlib.util
import shutil

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
HAS_BROWSER = CHROMIUM is not None and importlib.util.find_spec("playwright") is not None
NEEDS_BROWSER = pytest.mark.skipif(not HAS_BROWSER, reason="needs playwright and the program chromium")
