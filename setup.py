"""The README as PyPI shows it: its links and pictures lead to the repository, whose address stands in pyproject.toml.

Everything else about the package is in pyproject.toml. Without `Repository` in [project.urls] links stay as they are.
"""

import re
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent


def readme() -> str:
    """README.md with absolute links."""
    text, project = ((ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "pyproject.toml"))
    address = re.search(r'^Repository = "(.+?)/?"$', project, re.MULTILINE)
    if address is None:
        return text
    text = re.sub(r"(!\[[^]]*\])\((?!https?:|#)([^)]+)\)", rf"\1({address[1]}/raw/HEAD/\2)", text)
    return re.sub(r"(?<!!)(\[[^]]*\])\((?!https?:|#)([^)]+)\)", rf"\1({address[1]}/blob/HEAD/\2)", text)


setup(long_description=readme(), long_description_content_type="text/markdown")
