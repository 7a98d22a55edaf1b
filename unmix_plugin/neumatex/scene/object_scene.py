"""A validated object: its mesh, the light around it, and posed pictures of it.

World space is that of the mesh's file, and of the poses before nerfstudio's `applied_transform`; z is up. Model space
has the mesh's bounding box in the middle of [-1, 1]^3, axes as in the world.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from unmix_plugin.neumatex.geometry.mesh import Mesh
from unmix_plugin.neumatex.lighting.environment import Environment
from unmix_plugin.neumatex.scene.picture_files import read_picture
from unmix_plugin.neumatex.scene.posed_pictures import PosedPictures
from unmix_plugin.neumatex.scene.true_materials import TrueMaterials
from unmix_plugin.scenes.reading.splits import Split
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.spectral.bands import Bands


@dataclass(frozen=True)
class HeldOutLight:
    """The object under a light that training never sees."""

    name: str
    environment: Environment
    pictures: PosedPictures
    """All for evaluation."""


@dataclass(frozen=True)
class ObjectScene:
    """Everything known about an object; made by `load_object` only, which guarantees what is said here."""

    root: Path
    """Its folder."""
    mesh: Mesh
    """Model space."""
    environment: Environment
    """The light of the pictures, world directions."""
    frame: Normalisation
    """From world to model space."""
    pictures: PosedPictures
    """All views."""
    split: Split
    """Views to train on and views to evaluate, at least one each."""
    lights: tuple[HeldOutLight, ...]
    bands: Bands | None
    """Of spectral pictures; None for RGB."""
    lamp: Float64[np.ndarray, " B"] | None
    """Relative power of the light of spectral pictures, greatest band 1."""
    truth: Path | None
    """Folder of true base colours; None where there is none."""
    true_materials: TrueMaterials | None
    """Of spectral pictures, where they are known."""
    input_hashes: dict[str, str]
    """SHA-256 of mesh, environment and pictures."""
    notes: tuple[str, ...]
    """What is unusual but usable."""

    def base_colour(self, index: int) -> Float32[np.ndarray, "H W 3"] | None:
        """True base colour of a view, linear; None where it is unknown.

        Raises:
            SceneError: its file is malformed.
        """
        name = f"{self.pictures.files[index].name}.exr"
        if self.truth is None or not (self.truth / name).is_file():
            return None
        found: Float[np.ndarray, "H W 3"] = read_picture(self.truth / name).numbers
        return found

    def summary(self) -> dict[str, Any]:
        """What a run has to record of the object, as JSON-able values."""
        return {
            "root": str(self.root),
            "frames": self.pictures.names,
            "train_indices": list(self.split.train),
            "eval_indices": list(self.split.evaluation),
            "normalisation": self.frame.to_json(),
            "tone_mapping": self.pictures.tone,
            "lights": {light.name: light.pictures.names for light in self.lights},
            "input_hashes": dict(self.input_hashes),
        }
