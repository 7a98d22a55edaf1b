"""Packages that not every user needs, imported when a file of their format is opened."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from unmix_plugin.errors import CaptureError


def import_extra(package: str) -> ModuleType:
    """A package of the extra `captures`.

    Raises:
        CaptureError: it isn't installed.
    """
    try:
        return import_module(package)
    except ImportError as error:
        raise CaptureError(
            f"this file needs the package {package.partition('.')[0]}, which isn't installed ({error}): "
            "pip install 'unmix-nerf[captures]'"
        ) from error
