"""Makes docs/pictures/elsewhere.webp: an exported asset under two lights, in two programs that are not ours.

    python benchmarks/asset.py --seeds 11 --runs OUT
    python scripts/elsewhere.py --run OUT/runs/capture-11-96/neumatex/TIME --truth OUT/object-11-96

The first command writes an object whose truth is known and makes an asset of its cubes alone, with `unmix-asset`; it
takes about 15 minutes of two processor cores. The second one exports `material.glb` of the run as `unmix-asset` does,
reads it with trimesh for Mitsuba 3 and with the GLTFLoader of three.js for chromium, and lights it with the
environments of the two held-out lights, in colours. It needs the extra `reference`, npm and chromium.

Figures are of linear light in sRGB primaries, clamped to [0, 1], over pixels that the object covers alone. The pictures
of a light have one exposure, at which all but 1 % of the true pixels are below white.
"""

from __future__ import annotations

from gallery import PICTURES, browser_page, panels  # before torch, whose threads unmix_plugin sets

# isort: split
import base64
import io
import json
import math
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import tyro
from PIL import Image

from benchmarks import _mitsuba_scene
from unmix_plugin import Cameras
from unmix_plugin.commands.export import export
from unmix_plugin.neumatex.fit.object_scene import HeldOutLight, ObjectScene, load_object
from unmix_plugin.neumatex.fit.tone import psnr_db
from unmix_plugin.neumatex.fit.trained_object import TrainedObject
from unmix_plugin.neumatex.tracing.environment import Environment
from unmix_plugin.spectral.colour.conversion import linear_to_srgb, rgb_matrix, srgb_to_linear
from unmix_plugin.spectral.evidence import OPAQUE_ALPHA
from unmix_plugin.trained.open_run import load_run

THREE = "three@0.187.0"
Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""From the axes of glTF, +y up, to those of the object, +z up."""
TITLES = ("truth, from spectra", "unmix-render", "Mitsuba 3: material.glb", "three.js: material.glb")
_FINER = 4
"""Times finer than the picture that the browser draws along an edge."""
_MAP = (256, 512)
"""Rows and columns of an environment in the browser."""


@dataclass(frozen=True)
class Options:
    """Show an exported asset in programs that are not ours, beside the truth."""

    run: Path
    """Of neumatex, which `unmix-asset` made."""
    truth: Path
    """Folder of the object: its pictures under held-out lights below relit/."""
    view: int = 1
    """Which picture of each light is shown."""
    paths: int = 256
    """A pixel, of Mitsuba."""
    glb: Path | None = None
    """material.glb of the run; None: exported."""
    work: Path = Path("outputs/elsewhere")
    """Where material.glb and three.js are kept."""
    output: Path = PICTURES / "elsewhere.webp"
    """Where the picture goes."""


def main(options: Options) -> None:
    """Export, render everywhere, compare, write."""
    truth = load_object(options.truth)
    assert truth.bands is not None
    matrix = rgb_matrix(truth.bands)
    glb = options.glb or options.work / "material" / "material.glb"
    if options.glb is None:
        words = ["material", "--run", str(options.run), "--output", str(glb.parent), "--overwrite"]
        export([*words, "--texture-size", "512"])
    scene: Any = load_run(options.run, "cpu").scene
    rows = []
    for light in truth.lights:
        coloured = replace(light.environment, image=(light.environment.image @ matrix).clamp(min=0))
        camera, shot = world_camera(truth, light, options.view), light.pictures.read(options.view)
        alpha, colours = shot.opacity, (torch.from_numpy(shot.numbers) @ matrix).clamp(min=0).numpy()
        pictures = [
            np.concatenate([colours * alpha[..., None], alpha[..., None]], axis=-1),
            traced(scene, camera, light),
            in_mitsuba(glb, camera, coloured, options.paths),
            in_browser(glb, camera, coloured, options.work),
        ]
        shown = alpha >= OPAQUE_ALPHA
        exposure = 1 / float(np.quantile(colours[shown].max(axis=-1), 0.99))
        titles = [f"{light.name}: {TITLES[0]}", *TITLES[1:]]
        rows.append([(title, on_white(one, exposure)) for title, one in zip(titles, pictures, strict=True)])
        for title, picture in zip(TITLES[1:], pictures[1:], strict=True):
            error = torch.from_numpy(picture[shown][:, :3].clip(0, 1) - colours[shown].clip(0, 1))
            print(f"{light.name}, {title}: {float(psnr_db(error.square())):.2f} dB", flush=True)
    is_object = np.stack([picture for row in rows for _, picture in row]) < 0.97
    columns = np.flatnonzero(is_object.any(axis=(0, 1, 3)))
    part = slice(max(columns[0] - 6, 0), columns[-1] + 7)
    panels(options.output, [[(title, picture[:, part]) for title, picture in row] for row in rows])


def world_camera(truth: ObjectScene, light: HeldOutLight, index: int) -> Cameras:
    """A camera of a held-out light in the axes and units of the object's files."""
    camera = light.pictures.cameras[index]
    pose = camera.camera_to_world[0].double().numpy()
    place = truth.frame.to_world(pose[:, 3])
    pose = np.column_stack([truth.frame.rotation.T @ pose[:, :3], place])
    return replace(camera, camera_to_world=torch.from_numpy(pose).float()[None])


def on_white(picture: np.ndarray, exposure: float) -> np.ndarray:
    """Linear light multiplied by its alpha (H, W, 4) on white, in sRGB."""
    light = (picture[..., :3] * exposure).clip(0, 1) + 1 - picture[..., 3:].clip(0, 1)
    return linear_to_srgb(torch.from_numpy(light).clamp(0, 1)).numpy()


def traced(scene: TrainedObject, camera: Cameras, light: HeldOutLight) -> np.ndarray:
    """The trained material in all bands, as `unmix-render` shows it."""
    poses = scene.frame.moved(camera.camera_to_world.double().numpy())
    lit = replace(scene, environment=light.environment)
    view = lit.look(replace(camera, camera_to_world=torch.from_numpy(poses).float()))
    return torch.cat([view["linear_rgb"], view["accumulation"][..., None]], dim=-1).numpy()


def in_mitsuba(glb: Path, camera: Cameras, light: Environment, paths: int) -> np.ndarray:
    """A picture (H, W, 4) by path tracing, the principled material given the textures of a glTF."""
    import mitsuba  # pyright: ignore[reportMissingImports] - of the extra "reference"

    mitsuba.set_variant("scalar_rgb")
    parts: Any = trimesh.load_scene(glb).dump()  # the nodes' transforms applied
    [mesh] = parts
    look = mesh.visual.material
    assert (look.metallicFactor, look.roughnessFactor) == (1, 1)
    packed = np.asarray(look.metallicRoughnessTexture.convert("RGB"))
    colour = np.asarray(look.baseColorTexture.convert("RGB"))

    def texture(values: np.ndarray, *, is_linear: bool) -> dict[str, Any]:
        bitmap = mitsuba.Bitmap(values.copy())
        return {"type": "bitmap", "bitmap": bitmap, "raw": is_linear, "wrap_mode": "clamp"}

    properties = mitsuba.Properties()
    properties["mesh_bsdf"] = mitsuba.load_dict(
        {
            "type": "principled",
            "base_color": texture(colour, is_linear=False),
            "roughness": texture(packed[..., 1:2], is_linear=True),
            "metallic": texture(packed[..., 2:3], is_linear=True),
            "specular": 0.5,
        }
    )
    count, kinds = len(mesh.vertices), {"has_vertex_normals": True, "has_vertex_texcoords": True}
    shape = mitsuba.Mesh("asset", count, len(mesh.faces), props=properties, **kinds)
    values = mitsuba.traverse(shape)
    values["vertex_positions"] = np.float32(mesh.vertices @ Z_UP.T).ravel()
    values["vertex_normals"] = np.float32(mesh.vertex_normals @ Z_UP.T).ravel()
    values["vertex_texcoords"] = np.float32(
        mesh.visual.uv * [1, -1] + [0, 1]
    ).ravel()  # trimesh has v upwards
    values["faces"] = np.uint32(mesh.faces).ravel()
    values.update()
    integrator = {"type": "path", "max_depth": 8, "hide_emitters": True}
    lamp = _mitsuba_scene.environment_light(mitsuba, light)
    bodies = {"asset": shape, "light": lamp, "sensor": _mitsuba_scene.sensor(mitsuba, camera)}
    scene = mitsuba.load_dict({"type": "scene", "integrator": integrator, **bodies})
    return np.array(mitsuba.render(scene, spp=paths))


PAGE = """<!doctype html><style>body { margin: 0 }</style>
<script type="importmap">{"imports": {"three": "/three/build/three.module.js", "three/": "/three/"}}</script>
<script type="module">
import * as three from "three";
import { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
const given = await (await fetch("/given.json")).json();
const renderer = new three.WebGLRenderer({ alpha: true, preserveDrawingBuffer: true });
renderer.setSize(given.width, given.height);
const scene = new three.Scene();
const numbers = new Float32Array(await (await fetch("/light.bin")).arrayBuffer());
const light = new three.DataTexture(numbers, given.columns, given.rows, three.RGBAFormat, three.FloatType);
light.mapping = three.EquirectangularReflectionMapping;
light.magFilter = light.minFilter = three.LinearFilter;
light.needsUpdate = true;
scene.environment = light;
scene.add((await new GLTFLoader().loadAsync("/material.glb")).scene);
const camera = new three.PerspectiveCamera(given.angle, given.width / given.height, 0.01, 1000);
camera.applyMatrix4(new three.Matrix4().fromArray(given.pose));
renderer.render(scene, camera);
window.picture = renderer.domElement.toDataURL();
</script>"""


def in_browser(glb: Path, camera: Cameras, light: Environment, work: Path) -> np.ndarray:
    """A picture (H, W, 4) as three.js draws a glTF in an environment: by rasterisation, without shadows."""
    modules, (width, height) = work / "node_modules", camera.size(0)
    if not (modules / "three").is_dir():
        subprocess.run(["npm", "install", "--silent", "--no-save", "--prefix", str(work), THREE], check=True)
    pose = np.eye(4)
    pose[:3] = Z_UP.T @ camera.camera_to_world[0].double().numpy()
    given = {
        "width": _FINER * width,
        "height": _FINER * height,
        "angle": 2 * math.degrees(math.atan(height / 2 / float(camera.focal_px[0, 1]))),
        "pose": pose.T.ravel().tolist(),
        "rows": _MAP[0],
        "columns": _MAP[1],
    }
    files = {
        "/": PAGE.encode(),
        "/given.json": json.dumps(given).encode(),
        "/light.bin": equirectangular(light).tobytes(),
        "/material.glb": glb.read_bytes(),
    }
    with browser_page(_FINER * width, _FINER * height) as page:
        page.on("pageerror", lambda error: print(f"three.js: {error}"))
        page.route("**/*", lambda route: _answer(route, files, modules))
        page.goto("http://asset.example/")
        page.wait_for_function("window.picture")
        drawn = page.evaluate("window.picture").split(",")[1]
    encoded = np.asarray(Image.open(io.BytesIO(base64.b64decode(drawn))).convert("RGBA"), np.float32) / 255
    colours, alpha = srgb_to_linear(torch.from_numpy(encoded[..., :3])).numpy(), encoded[..., 3:]
    fine = np.concatenate([colours * alpha, alpha], axis=-1)
    return fine.reshape(height, _FINER, width, _FINER, 4).mean(axis=(1, 3))


def _answer(route: Any, files: Mapping[str, bytes], modules: Path) -> None:
    """What the page asks for: a file of ours or one of three.js."""
    name = "/" + route.request.url.split("/", 3)[3]
    if name in files:
        route.fulfill(
            body=files[name], content_type="text/html" if name == "/" else "application/octet-stream"
        )
    elif name.startswith("/three/"):
        route.fulfill(path=modules / name[1:])
    else:
        route.fulfill(status=404)


def equirectangular(light: Environment) -> np.ndarray:
    """An environment as three.js has it: (rows, columns, 4) float32, the lowest row first, +y up, +x in the middle."""
    rows, columns = _MAP
    height, turn = np.meshgrid(
        ((np.arange(rows) + 0.5) / rows - 0.5) * np.pi,
        ((np.arange(columns) + 0.5) / columns - 0.5) * 2 * np.pi,
        indexing="ij",
    )
    flat = np.cos(height)
    directions = np.stack([flat * np.cos(turn), np.sin(height), flat * np.sin(turn)], axis=-1) @ Z_UP.T
    radiance = light.radiance(torch.from_numpy(directions.reshape(-1, 3)).float()).numpy()
    whole = np.concatenate([radiance, np.ones_like(radiance[:, :1])], axis=1)
    return np.ascontiguousarray(whole.reshape(rows, columns, 4), np.float32)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
