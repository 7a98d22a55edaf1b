"""The product `material`: everything that others need to use a trained material."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from unmix_plugin.errors import ConfigError
from unmix_plugin.products.product import Job, RunProduct

_SIZES = (16, 8192)
_FAR_OFF = 0.05
"""Share of the reflected light from which the difference of the glTF material shows."""


@dataclass(frozen=True)
class MaterialProduct(RunProduct):
    """The material on the mesh: material.glb, a glTF with its nearest metallic-roughness material; textures of base
    colour, roughness, metallicity and latents as PNG and EXR; parameters.exr, all parameters; decoder.glsl and
    decoder.json, with which other programs can use the latents; material.json, which says what is what."""

    name = "material"

    texture_size: int = 1024
    """Width and height of the textures, texels."""

    def __post_init__(self) -> None:
        low, high = _SIZES
        if not low <= self.texture_size <= high:
            raise ConfigError(f"--texture-size is {self.texture_size}; choose {low} to {high} texels")

    def write(self, job: Job) -> list[Path]:
        """Unwrap, bake, fit, write."""
        from unmix_plugin.neumatex.export.material import material_paths, write_material
        from unmix_plugin.neumatex.fit.trained_object import TrainedObject
        from unmix_plugin.products.mesh import say_units
        from unmix_plugin.trained.run_views import world_up

        scene = job.loaded.scene
        assert isinstance(scene, TrainedObject)  # what else has another method and is refused before
        job.claim(material_paths(job.folder, scene.surface.family))
        with job.working("unwrapping the mesh and baking its material"):
            written, error = write_material(
                job.folder,
                scene.mesh,
                scene.surface,
                scene.frame,
                self.texture_size,
                bands=scene.bands,
                up=world_up(scene.views, scene.frame),
                metres_per_unit=None if job.loaded.scale is None else job.loaded.scale.metres_per_unit,
            )
        message = (
            f"the glTF material differs from the trained one by {100 * error:.1f} % of the reflected light"
        )
        if error > _FAR_OFF:
            message += (
                ": its base colour, roughness and metallicity can't express it. Where that shows, draw it with "
                "decoder.glsl, or with unmix-render, which traces the trained one"
            )
        job.say(message)
        say_units(job, "material.glb")
        return written
