"""How the viewer is served, as flags of commands."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.engine.training.training_control import SHARE_BOUNDS
from unmix_plugin.errors import ConfigError

LOCAL_HOST = "127.0.0.1"


@dataclass(frozen=True)
class ViewerOptions:
    """How the viewer is served."""

    host: str = LOCAL_HOST
    """Address to listen at. Any but this machine's loopback lets others reach the viewer: give a token then."""
    port: int = 7007
    """Port to listen at; if it is taken the next free one is used, and said."""
    token: str | None = None
    """Word that the page asks for before it shows anything."""
    environments: tuple[Path, ...] = ()
    """Environment maps (.exr, .hdr) to offer beside the built-in ones, for methods that know light and material
    apart."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: a port out of range, an empty host or an empty token.
        """
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"--viewer.port is a number from 0 (any free one) to 65535; found {self.port}")
        if not self.host.strip():
            raise ConfigError("--viewer.host is empty; leave it out to listen on this machine only")
        if self.token is not None and not self.token.strip():
            raise ConfigError("--viewer.token is empty; leave it out or give a word that others can't guess")


@dataclass(frozen=True)
class TrainingViewerOptions(ViewerOptions):
    """How a training is shown in the browser."""

    enabled: bool = False
    """Serve the viewer while training; on by default where the output is a terminal."""
    keep_open: bool = False
    """Serve on after training until Ctrl-C, rather than as long as a page is open."""
    share: float = 0.3
    """Part of the device's time that the viewer may take while someone moves the camera; at rest it takes about a
    quarter of that."""

    def __post_init__(self) -> None:
        """Refuse impossible settings.

        Raises:
            ConfigError: as `ViewerOptions`, or a share out of range.
        """
        super().__post_init__()
        low, high = SHARE_BOUNDS
        if not low <= self.share <= high:
            raise ConfigError(f"--viewer.share is a part from {low:g} to {high:g}; found {self.share}")
