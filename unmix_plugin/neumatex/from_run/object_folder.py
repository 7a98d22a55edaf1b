"""The folder of an object, written from a run of unmix-nerf on its pictures: nothing else has to be prepared.

The mesh is the surface that the run has learnt, closed and decimated; cameras are those that it refined; pictures are
those that it was trained on, as links where the disk allows it. The light is that of the scene's folder where one lies
there, or else the one that shading and shadows tell. A mesh or an environment that a user gives takes the place of the
run's.

The folder lies in the exports of the run and is named for what it was made of, so that the same is made once.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import fast_simplification
import numpy as np
from jaxtyping import Float64
from PIL import Image

from unmix_plugin.engine import Decision, TrainerConfig
from unmix_plugin.errors import ConfigError, SceneError
from unmix_plugin.formats.exr import write_spectral_exr
from unmix_plugin.formats.files import hash_of, make_folder, safe_name, write_file
from unmix_plugin.formats.meshes import write_ply
from unmix_plugin.neumatex.fit.data_manager import ObjectDataManagerConfig
from unmix_plugin.neumatex.fit.object_scene import (
    DECISIONS_FILE,
    LIGHT_UNKNOWN,
    Estimated,
    load_posed_object,
)
from unmix_plugin.neumatex.fit.settings import NeumatexModelConfig
from unmix_plugin.neumatex.fit.start import RunMaterials
from unmix_plugin.neumatex.from_run.light_frame import FramedLight, framed_light
from unmix_plugin.neumatex.tracing.light_files import ENVIRONMENT_SUFFIXES, read_lamp
from unmix_plugin.scenes.demo.scene import written_once
from unmix_plugin.scenes.folder import (
    METRES_KEY,
    SceneKeys,
    load_transforms,
    read_scene_keys,
    transforms_bytes,
)
from unmix_plugin.scenes.reading.faults import FILE_NAME, Faults, resolve_path
from unmix_plugin.scenes.scene import Scene
from unmix_plugin.settings import UnmixModelConfig
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv
from unmix_plugin.trained.camera_files import camera_entry
from unmix_plugin.trained.open_run import LoadedRun, find_scene, load_run
from unmix_plugin.trained.run_views import positions_for_files
from unmix_plugin.trained.surface_mesh import TriangleMesh, surface_of

_RECIPE_FILE, _VERSION = "made_of.json", 4
"""What a folder was made of, written last; the version of how."""
_FRAME_OF_RUN_WRONG = {
    True: "warning: the run took its light to stand still, but shading on its mesh is explained by a lamp that turns "
    "with the camera, which is used; train the run again with --light camera",
    False: "warning: the run took its light to move with the camera, but shading on its mesh is explained by light "
    "that stands still, which is used; train the run again with --light fixed",
}
_MOST_UNSEEN = 0.02
"""Part of the surface that no camera sees, from which that is worth a word."""

Say = Callable[[str], object]
"""What to do with a line about the progress."""


@dataclass(frozen=True)
class ObjectRecipe:
    """What an object is made of."""

    run: Path
    """Of unmix-nerf."""
    num_triangles: int
    """Of the mesh, at most."""
    mesh: Path | None = None
    """Given in place of the run's."""
    environment: Path | None = None
    """Given in place of the scene's, or of one that is estimated."""
    lamp: str | None = None
    """Spectrum of the light, as `read_lamp` takes it, in place of the scene's."""

    def described(self, loaded: LoadedRun) -> dict[str, Any]:
        """All that a change of makes another folder, as JSON has it."""
        table = Path(self.lamp) if self.lamp is not None and Path(self.lamp).is_file() else None
        files = {"mesh": self.mesh, "environment": self.environment, "lamp": table}
        given = {name: None if path is None else hash_of(path) for name, path in files.items()}
        given = {**given, "named lamp": self.lamp}
        step = loaded.training.steps
        scene = loaded.record.summary.get("input_hashes")
        return {"version": _VERSION, "step": step, "triangles": self.num_triangles, **given, "scene": scene}


def object_of_run(recipe: ObjectRecipe, say: Say) -> Path:
    """The folder of an object, made if it is not there.

    Raises:
        RunError: the run is unusable, or has no surface.
        ConfigError: the run has no mixed materials, or several sensors; its light moves with the camera beside a map
            that stands still.
        SceneError: its scene is gone or has changed, or the folder can't be written.
    """
    for path in (recipe.mesh, recipe.environment):
        if path is not None and not path.is_file():
            raise SceneError(f"{path}: there is no such file")
    loaded = load_run(recipe.run, "cpu")
    content = recipe.described(loaded)
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]
    name = safe_name(loaded.scene_name, fallback="object")

    def is_complete(folder: Path) -> bool:
        with suppress(OSError, ValueError):
            return json.loads((folder / _RECIPE_FILE).read_text(encoding="utf-8")) == content
        return False

    def write(folder: Path) -> None:
        _write_object(make_folder(folder), recipe, loaded, say)
        write_file(folder / _RECIPE_FILE, json.dumps(content, indent=1).encode())

    target = loaded.folder.exports / f"object-{digest}" / name
    if not is_complete(target):
        say(f"object of {recipe.run}: {target}")
    remedy = "give a copy of the run that can be written"
    return written_once(target, "the object", write, is_complete, remedy)


def _write_object(folder: Path, recipe: ObjectRecipe, loaded: LoadedRun, say: Say) -> None:
    """Pictures and cameras, then the mesh, then the light."""
    scene = find_scene(loaded.record.summary, loaded.folder.path, None)
    if scene is None:
        raise SceneError(
            f"{loaded.record.summary.get('root')}: the scene of {recipe.run} is not there any more, or has changed; "
            "put it back, since the materials are fitted to its pictures"
        )
    if scene.is_rig:
        raise ConfigError(
            f"{recipe.run}: its pictures are of several sensors or sizes, and an object needs cubes of all bands; "
            "train unmix-nerf on those of one sensor"
        )
    content = _write_pictures(folder, recipe, loaded, scene, say)
    decisions = list[Decision]()
    if recipe.mesh is None:
        decisions.append(_write_mesh(folder, recipe, loaded, say))
    faults = Faults(scene.root)
    keys = read_scene_keys(load_transforms(scene.root, faults).scene, faults)
    faults.raise_if_any()
    environment = {} if recipe.environment is not None else _copied_environment(folder, scene, keys)
    if environment and _moves_with_camera(loaded):
        raise ConfigError(
            f"{recipe.run}: its light moves with the camera, and the environment map of the scene's folder stands "
            "still; take the map away, or train the run with --light fixed if the light did stand still"
        )
    (folder / FILE_NAME).write_bytes(transforms_bytes({**content, **environment}))
    estimated = Estimated(has_mesh=recipe.mesh is None)
    if recipe.environment is None and not environment:
        white = None if keys.reflectance_of_1 is None else 1 / keys.reflectance_of_1
        light, axes = _write_light(folder, recipe, loaded, white, say)
        (folder / FILE_NAME).write_bytes(transforms_bytes({**content, **axes}))
        decisions.append(light.decision)
        estimated = replace(estimated, light=None if light.decision.is_undecided else light.light)
    estimated.write(folder)
    write_file(folder / DECISIONS_FILE, json.dumps([each.to_json() for each in decisions], indent=1).encode())


def _write_pictures(
    folder: Path, recipe: ObjectRecipe, loaded: LoadedRun, scene: Scene, say: Say
) -> dict[str, Any]:
    """Cubes, pictures, masks, truth and other lights of a scene; the content of transforms.json but for what else is
    known."""
    trained, bands = loaded.materials_scene, Bands(scene.wavelengths_nm)
    views = {view.name: view for view in trained.views}
    shown = [index for index, frame in enumerate(scene.frames) if frame.name in views]
    is_linked, gains = _is_clean(scene), dict[int, np.ndarray]()
    if trained.view_gains is not None:
        gains, is_linked = (
            dict(zip(scene.train_indices, trained.view_gains.double().numpy(), strict=True)),
            False,
        )
        say(
            "exposures that training found are undone in its views; views that are kept apart stay as they are"
        )
    frames = [
        _write_frame(folder, scene, index, None if is_linked else gains.get(index, np.ones(1)))
        for index in shown
    ]
    splits: dict[str, list[str]] = {"train": [], "eval": []}
    for index, frame in zip(shown, frames, strict=True):
        view = views[scene.frames[index].name]
        width, height = view.camera.size(0)
        frame |= {**camera_entry(view, trained.frame), "w": width, "h": height}
        splits[view.split].append(frame["hyperspectral_file_path"])
    content: dict[str, Any] = {"camera_model": "OPENCV", "tone_mapping": "linear"}
    content |= {"train_filenames": splits["train"], "val_filenames": splits["eval"]}
    content["wavelengths"] = scene.wavelengths_nm.tolist()
    if is_linked and scene.options.value_scale is not None:
        content["value_scale"] = scene.options.value_scale
    lamp = scene.illuminant if recipe.lamp is None else read_lamp(recipe.lamp, bands)
    if lamp is not None:
        table = SpectraTable(bands, ("power",), lamp[None])
        write_spectra_csv(folder / "illuminant.csv", table)
        content["illuminant_path"] = "illuminant.csv"
    if scene.endmembers is not None and scene.material_names is not None:
        table = SpectraTable(bands, scene.material_names, scene.endmembers)
        write_spectra_csv(folder / "endmembers.csv", table)
        content |= {"endmembers_path": "endmembers.csv", "materials": list(scene.material_names)}
    if loaded.scale is not None:
        content[METRES_KEY] = loaded.scale.metres_per_unit
    if (scene.root / "relit").is_dir():
        shutil.copytree(scene.root / "relit", folder / "relit", copy_function=_link)
    return {**content, "frames": frames}


def _is_clean(scene: Scene) -> bool:
    """Whether cubes hold light alone, which is all that neumatex takes."""
    return scene.options.invalid_pixels == "refuse"


def _write_frame(
    folder: Path, scene: Scene, index: int, gain: Float64[np.ndarray, " #B"] | None
) -> dict[str, Any]:
    """The files of a view, each in a folder of its kind; gives their keys. Cubes are links without a gain, or else
    written again, divided by it."""
    frame, entry = scene.frames[index], dict[str, Any]()
    files = {
        "file_path": ("images", frame.image_path),
        "hyperspectral_file_path": ("cubes", frame.cube_path),
        "mask_path": ("masks", frame.mask_path),
        "abundance_file_path": ("abundances", frame.abundance_path),
    }
    cube, mask = (folder / place / frame.name for place in ("cubes", "masks"))
    if gain is not None:
        np.save(make_folder(cube.parent) / f"{cube.name}.npy", (scene.cube(index) / gain).astype(np.float32))
        entry["hyperspectral_file_path"] = f"cubes/{cube.name}.npy"
    if not _is_clean(scene):
        valid = Image.fromarray(scene.valid_mask(index).astype(np.uint8) * 255)
        valid.save(make_folder(mask.parent) / f"{mask.name}.png")
        entry["mask_path"] = f"masks/{mask.name}.png"
    for key, (place, path) in files.items():
        if path is not None and key not in entry:
            entry[key] = f"{place}/{frame.name}{path.suffix}"
            _link(path, folder / entry[key])
    return entry


def _link(source: str | Path, target: str | Path) -> str:
    """A second name of a file, or where the disk has none a copy."""
    source, target = Path(source).resolve(), Path(target)
    make_folder(target.parent)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
    return str(target)


def _write_mesh(folder: Path, recipe: ObjectRecipe, loaded: LoadedRun, say: Say) -> Decision:
    """The surface of the run in the scene's world."""
    say("looking for its surface ...")
    whole, unseen = surface_of(loaded.materials_scene, keeps_unseen=True)
    vertices, faces = whole.vertices.astype(np.float64), whole.faces
    if len(faces) > recipe.num_triangles:
        found = fast_simplification.simplify(vertices, faces, target_count=recipe.num_triangles)
        vertices, faces = found[:2]
    vertices = positions_for_files(loaded.scene.frame.to_world(vertices))
    # Highlights show where a surface faces: of a rough one, normals are smoothed, places stay.
    normals = TriangleMesh(vertices, faces).smoothed_normals.astype(np.float32)
    columns = {name: vertices[:, axis] for axis, name in enumerate("xyz")}
    columns |= {name: normals[:, axis] for axis, name in enumerate(("nx", "ny", "nz"))}
    write_ply(folder / "mesh.ply", columns, faces, ("surface of an unmix-nerf run",))
    guess = (
        f"{unseen:.0%} of it no camera sees, which is closed by a guess: capture the object from there, too"
    )
    doubt = guess if unseen > _MOST_UNSEEN else "no part of it is unseen"
    say(f"mesh of {len(faces):,} triangles; {doubt}")
    return Decision(
        "mesh",
        "closed surface of the run",
        {
            "triangles": len(faces),
            "before it was decimated": len(whole.faces),
            "part that no camera sees": unseen,
        },
        "outlines of mesh and alpha that differ, which is refused or noted when training begins",
        "--mesh",
    )


def _moves_with_camera(loaded: LoadedRun) -> bool:
    """Whether the run's light moves with the camera, or the object was turned before a lamp."""
    model = loaded.config.pipeline.model
    return isinstance(model, UnmixModelConfig) and model.light == "camera"


def _write_light(
    folder: Path, recipe: ObjectRecipe, loaded: LoadedRun, white: float | None, say: Say
) -> tuple[FramedLight, dict[str, Any]]:
    """The light that shading and shadows on the mesh tell, as an environment map of all bands, and the keys of
    transforms.json that say in which axes it stands still. The folder is read back, so what it holds so far has to be
    whole. `white` is what a white surface reads in the pictures, where they were divided by a white reference."""
    say("looking for its light ...")
    known = load_posed_object(folder, recipe.mesh)
    assert known.bands is not None
    run = RunMaterials(recipe.run, loaded.materials_scene)
    found = framed_light(known, run, white, run_says_moving=_moves_with_camera(loaded))
    if found.contradicts_run:
        say(_FRAME_OF_RUN_WRONG[found.frame is not None])
    say(LIGHT_UNKNOWN if found.decision.is_undecided else f"light: {found.decision.outcome}")
    keys, axes_of_map = dict[str, Any](), "+z is the top, +x the middle column"
    if found.frame is not None:
        axes_of_map += "; x is towards the camera, y to its right, see environment_moves in transforms.json"
        middle = known.frame.to_world(np.array([found.frame.middle]))[0]
        moves = {"kind": found.frame.kind, "middle": middle.tolist(), "axis": list(found.frame.axis)}
        keys["environment_moves"] = moves
    about = f"light of an object as shading and shadows on its mesh tell it; {axes_of_map}"
    write_spectral_exr(folder / "environment.exr", found.radiance.numpy(), known.bands, None, comments=about)
    return found, keys


def _copied_environment(folder: Path, scene: Scene, keys: SceneKeys) -> Mapping[str, Any]:
    """The environment map of a scene's folder as keys of transforms.json; nothing where there is none."""
    faults = Faults(scene.root)
    found = [scene.root / f"environment{suffix}" for suffix in ENVIRONMENT_SUFFIXES]
    path = next((path for path in found if path.is_file()), None)
    if keys.environment_path is not None:
        path = resolve_path(scene.root, keys.environment_path, None, "'environment_path'", faults)
    faults.raise_if_any()
    if path is None:
        return {}
    name = f"environment{path.suffix.lower()}"
    _link(path, folder / name)
    placement = {
        "environment_rotation_deg": keys.environment_rotation_deg,
        "environment_exposure_stops": keys.environment_exposure_stops,
    }
    return {"environment_path": name, **{key: value for key, value in placement.items() if value is not None}}


def with_object_made(config: TrainerConfig) -> TrainerConfig:
    """Settings with the object's folder as data, which is made of --from-run where no data is given; files that they
    name are found from any working directory then. Errors are those of `object_of_run`."""
    model, data = config.pipeline.model, config.pipeline.datamanager
    if not isinstance(model, NeumatexModelConfig) or not isinstance(data, ObjectDataManagerConfig):
        return config  # of a method that took ours for its own
    run, mesh, environment = (
        None if path is None else path.resolve() for path in (model.from_run, data.mesh, data.environment)
    )
    pipeline = replace(
        config.pipeline,
        model=replace(model, from_run=run),
        datamanager=replace(data, mesh=mesh, environment=environment),
    )
    config = replace(config, pipeline=pipeline)
    if config.data is not None or run is None:
        return config
    recipe = ObjectRecipe(run, data.mesh_triangles, mesh, environment, data.lamp)
    return replace(config, data=object_of_run(recipe, lambda line: sys.stderr.write(f"{line}\n")))
