"""`unmix-asset --data SCENE` or `unmix-asset LAYOUT --data CAPTURE`: from spectral images, posed or as an instrument
wrote them, to an object that any light can fall on.

A scene of the capture, a radiance field of materials, the surface and the light that it tells, relightable materials
fitted on them, the evaluation on views left out, and files for other programs: what `unmix-process`, `unmix-train`
twice, `unmix-eval` and `unmix-export` do one after the other.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import tyro

from unmix_plugin.engine.configs import DeviceName
from unmix_plugin.engine.printing import tell
from unmix_plugin.errors import ConfigError


@dataclass(frozen=True)
class _AssetOptions:
    """Make an object of a scene folder: train a field, take mesh and light from it, fit relightable materials, evaluate
    them, and write glTF, textures of materials, the environment, a page, splats, and asset.json with what each is.

    Before all options there may be a LAYOUT of unmix-process, as in unmix-asset cubes --data CAPTURE --white FILE: the
    scene is then made of a capture first, and all options of unmix-process are taken, too (unmix-process --help).

    Every step can be repeated and changed by the command that is printed before it.
    """

    data: Path
    """Folder of posed spectral images, as unmix-train takes it; after a LAYOUT that of the capture."""
    scene: Path | None = None
    """After a LAYOUT: folder to write the scene to; None: of the capture's name, in scenes/ of --output-dir."""
    output: Path | None = None
    """Folder to write to; None: exports/asset in the second run's folder."""
    field_seconds: float = 300.0
    """Time to train the field, whose surface and materials all else starts from."""
    material_seconds: float = 240.0
    """Time to fit the materials."""
    endmembers: str | None = None
    """How many materials, or auto; None: what unmix-train does by default."""
    mesh: Path | None = None
    """Mesh in place of the field's surface."""
    environment: Path | None = None
    """Environment map in place of the estimated light."""
    mesh_triangles: int = 20_000
    """Of the surface, at most."""
    texture_size: int = 1024
    """Width and height of the textures, texels."""
    page_resolution: int = 128
    """Vertices along the longest edge of the object in the page."""
    splat_steps: int = 1000
    """Steps in which splats are fitted to the field."""
    output_dir: Path = Path("outputs")
    """Folder for the two runs."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Replace earlier files in the output folder, and a scene that was made of a capture."""
    device: DeviceName = "auto"
    """Where to compute; auto takes CUDA where there is one."""

    def __post_init__(self) -> None:
        for name, seconds in (("field", self.field_seconds), ("material", self.material_seconds)):
            if not 0 < seconds < float("inf"):
                raise ConfigError(f"--{name}-seconds is {seconds:g}; it must be above 0")


def asset(arguments: list[str]) -> None:
    """Parse the arguments, do what the commands do, say what was written where."""
    options, of_capture = _parse(arguments)

    from unmix_plugin.commands.eval import evaluate
    from unmix_plugin.commands.export import export
    from unmix_plugin.commands.process import process
    from unmix_plugin.commands.reporting import shell_line
    from unmix_plugin.commands.train import train
    from unmix_plugin.engine.runs.run_folder import newest_run
    from unmix_plugin.formats.files import refuse_to_overwrite

    if options.output is not None:
        refuse_to_overwrite([options.output / _MANIFEST], options.overwrite)
    device = ["--device", options.device]
    runs = ["--output-dir", str(options.output_dir), *device]
    numbers = count(1)

    def step(what: str, program: str, words: Sequence[str]) -> None:
        number = f"{next(numbers)}/{6 + bool(of_capture)}"
        tell(f"\n[{number}] {what}\n{shell_line(program, *words)}")

    if of_capture:
        step("a scene of the capture", "unmix-process", of_capture)
        process(of_capture)

    words = ["unmix-nerf", "--data", str(options.data), "--max-seconds", f"{options.field_seconds:g}", *runs]
    words += [] if options.endmembers is None else ["--endmembers", options.endmembers]
    step("a radiance field of materials", "unmix-train", words)
    train(words)
    field = newest_run(options.output_dir).path

    words = ["neumatex", "--from-run", str(field), "--max-seconds", f"{options.material_seconds:g}", *runs]
    words += ["--mesh-triangles", str(options.mesh_triangles)]
    for name, path in (("--mesh", options.mesh), ("--environment", options.environment)):
        words += [] if path is None else [name, str(path)]
    step("mesh, light, and materials on the mesh", "unmix-train", words)
    train(words)
    run = newest_run(options.output_dir)

    words = ["--run", str(run.path), *device]
    step("evaluation on views left out", "unmix-eval", words)
    evaluate(words)

    folder = (options.output or run.exports / "asset").resolve()
    into = ["--output", str(folder), *(["--overwrite"] if options.overwrite else [])]
    common = [*words, *into]
    words = ["material", *common, "--texture-size", str(options.texture_size)]
    step("glTF and textures", "unmix-export", words)
    export(words)
    words = ["page", *common, "--resolution", str(options.page_resolution)]
    step("a page in 3-D", "unmix-export", words)
    export(words)
    words = ["splats", "--run", str(field), *device, *into, "--steps", str(options.splat_steps)]
    step("splats that look like the field", "unmix-export", words)
    export(words)
    manifest = _write_manifest(folder, field, run.path)
    tell(f"\nobject: {folder / 'material.glb'}, {folder / 'page.html'}")
    tell(f"what is what, figures and decisions: {manifest}")
    tell(f"look at it in any light: {shell_line('unmix-view', '--run', run.path)}")


_MANIFEST, _ENVIRONMENT = "asset.json", "environment.exr"


def _parse(arguments: Sequence[str]) -> tuple[_AssetOptions, list[str]]:
    """What was asked, `data` a scene folder, and the words of unmix-process that make it of a capture; none where it
    is there. Raises ConfigError: options of unmix-process that no capture makes right."""
    if not arguments or arguments[0].startswith("-"):
        options = tyro.cli(_AssetOptions, prog="unmix-asset", args=arguments)
        if options.scene is not None:
            raise ConfigError(
                "--scene is where the scene of a capture goes, whose LAYOUT comes first, as in unmix-asset cubes "
                "--data CAPTURE; a scene folder that is there is named with --data alone"
            )
        return options, []

    from unmix_plugin.captures.options import ProcessOptions, check_options

    layout, *others = arguments
    options, remaining = tyro.cli(_AssetOptions, prog="unmix-asset", args=others, return_unknown_args=True)
    scene = options.scene or options.output_dir / "scenes" / options.data.resolve().name
    words = [layout, "--data", str(options.data), "--output-dir", str(scene), *remaining]
    words += ["--overwrite"] if options.overwrite else []
    check_options(tyro.cli(ProcessOptions, prog=f"unmix-asset {layout}", args=words))
    return replace(options, data=scene), words


def _write_manifest(folder: Path, field: Path, path: Path) -> Path:
    """The light as a map, and asset.json: files, figures, decisions, units."""
    from unmix_plugin.formats.exr import write_spectral_exr
    from unmix_plugin.formats.files import write_file
    from unmix_plugin.neumatex.fit.object_scene import read_decisions
    from unmix_plugin.neumatex.fit.trained_object import TrainedObject
    from unmix_plugin.neumatex.tracing.environment import directions_of_pixels
    from unmix_plugin.trained.open_run import load_run

    loaded = load_run(path, "cpu")
    scene, data = loaded.scene, loaded.config.data
    assert isinstance(scene, TrainedObject)
    assert scene.bands is not None
    light, about = scene.environment, "light that the materials were fitted in"
    if light.moves is not None:
        about += ", which turned with the camera, as it stood for the first view"
        light = light.seen_from(scene.views[0].camera.camera_to_world[0, :, 3])
    about += "; +z of the world is the top, its +x the middle column"
    height, width = light.image.shape[:2]
    upright = light.radiance(directions_of_pixels(height, width).flatten(0, 1)).view(height, width, -1)
    write_spectral_exr(folder / _ENVIRONMENT, upright.numpy(), scene.bands, None, comments=about)
    figures: dict[str, Any] = json.loads((loaded.folder.eval / "metrics.json").read_text(encoding="utf-8"))
    figures.pop("per_image", None)
    content = {
        "version": 1,
        "files": {
            "material.glb": "the object: metallic-roughness, +y up, metres where the scale is known",
            "material.json": "what each texture holds",
            "abundances.exr": "abundances of the endmembers of endmembers.csv, a channel each, as a texture",
            _ENVIRONMENT: about,
            "page.html": "the object in 3-D under any light",
            "splats.glb": "Gaussians in the light of the pictures, KHR_gaussian_splatting, with abundances",
            "splats.ply": "the same for viewers of splats, -y up",
        },
        "metres_per_unit": None if loaded.scale is None else loaded.scale.metres_per_unit,
        "runs": {"field": str(field), "materials": str(path)},
        "figures": figures,
        "decisions": [] if data is None else [each.to_json() for each in read_decisions(data)],
    }
    return write_file(folder / _MANIFEST, json.dumps(content, indent=1).encode())
