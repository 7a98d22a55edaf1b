"""Do other programs open what is exported, and does it look the same there?

    python benchmarks/other_viewers.py [--run RUN] [--npm DIR]

Exports mesh and splats of a run. The engine of PlayCanvas loads the splats in Chromium (software rendering) as PLY and
as glTF, through a camera of the scene; its picture is compared with `unmix-render`'s. The reader of SuperSplat
(splat-transform) turns the PLY into a table, whose numbers are compared with another reader's. The Khronos validator
checks both GLB files. Fetches these programs with npm once; without npm or the network it says so and measures nothing.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import shutil
import subprocess
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro
from PIL import Image
from plyfile import PlyData

PACKAGES = ("playcanvas@2.23.3", "@playcanvas/splat-transform@2.7.1", "gltf-validator@2.0.0-dev.3.10")
SOFTWARE_GL = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
PAGE = """<!DOCTYPE html><body style="margin:0"><canvas id="c" width="WIDTH" height="HEIGHT"></canvas>
<script type="module">
import * as pc from '/playcanvas.mjs';
const canvas = document.getElementById('c');
const drawing = { deviceTypes: ['webgl2'], antialias: false, preserveDrawingBuffer: true };
const device = await pc.createGraphicsDevice(canvas, drawing);
const options = new pc.AppOptions();
options.graphicsDevice = device;
options.componentSystems = [pc.RenderComponentSystem, pc.CameraComponentSystem, pc.LightComponentSystem];
options.componentSystems.push(pc.GSplatComponentSystem);
options.resourceHandlers = [pc.TextureHandler, pc.ContainerHandler, pc.GSplatHandler];
const app = new pc.AppBase(canvas);
app.init(options);
app.setCanvasResolution(pc.RESOLUTION_FIXED, WIDTH, HEIGHT);
const camera = new pc.Entity();
camera.addComponent('camera', { clearColor: new pc.Color(0, 0, 0), fov: FOV, nearClip: NEAR, farClip: FAR });
const pose = new pc.Mat4().set(POSE);
camera.setPosition(pose.getTranslation());
camera.setRotation(new pc.Quat().setFromMat4(pose));
app.root.addChild(camera);
const kind = new URLSearchParams(location.search).get('kind');
const file = { url: `/splats.${kind}`, filename: `splats.${kind}` };
const asset = new pc.Asset('splats', kind === 'ply' ? 'gsplat' : 'container', file);
app.assets.add(asset);
asset.on('error', (error) => { window.failed = String(error); });
asset.ready(() => {
  const found = kind === 'ply' ? asset : asset.resource.gsplats[0];
  const entity = new pc.Entity();
  entity.addComponent('gsplat', { asset: found });
  app.root.addChild(entity);
  window.count = found.resource.gsplatData.numSplats;
  let frames = 0;
  app.on('frameend', () => { frames += 1; if (frames === 30) window.shown = canvas.toDataURL(); });
});
app.assets.load(asset);
app.start();
</script>"""


@dataclass(frozen=True)
class Options:
    """Open exported files with other programs."""

    run: Path | None = None
    """Run of unmix-nerf to export from, in place of training on the built-in scene."""
    max_seconds: float = 45.0
    """Seconds of training."""
    npm: Path | None = None
    """Folder with the programs' packages, filled where it is empty; None: a temporary one."""
    results: Path | None = None
    """Folder for other_viewers.json and other_viewers.md; None: beside the benchmarks."""
    quick: bool = False
    """Two seconds of training on a small scene."""


def main(options: Options) -> None:
    """Export, open, compare, publish."""
    machine = _machine.describe_machine()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-viewers-")))
        packages = fetched(options.npm or folder / "npm")
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        if packages is None or chromium is None:
            print("nothing measured: needs npm and the network, or --npm, and the program chromium")
            return
        run = options.run or train(options, folder)
        script = _common.console_script("unmix-export")
        for product in ("mesh", "splats"):
            words = [script, product, "--run", str(run), "--output", str(folder / product)]
            _common.run_command(words)
        _common.run_command([script, "splats", "--run", str(run), "--output", str(folder / "z"), "--up", "z"])
        measured = {
            "pictures": pictures(run, folder / "z", packages, chromium),
            "table": table(folder, packages),
            "validator": {
                name: validated(folder / name / f"{name}.glb", packages) for name in ("mesh", "splats")
            },
        }
    setting = {"packages": PACKAGES, "splats": measured["table"]["splats"]}
    question = "Exported splats and meshes in other programs"
    report = _common.Report("other_viewers", question, setting, machine, judge(measured), measured)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def fetched(folder: Path) -> Path | None:
    """The folder of the packages; None where they can't be had."""
    if not (folder / "node_modules" / "playcanvas").is_dir():
        if shutil.which("npm") is None:
            return None
        folder.mkdir(parents=True, exist_ok=True)
        words = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(folder), *PACKAGES]
        if subprocess.run(words, check=False).returncode != 0:
            return None
    return folder / "node_modules"


def train(options: Options, folder: Path) -> Path:
    """A run of the built-in scene."""
    size, seconds = ("32", 2.0) if options.quick else ("96", options.max_seconds)
    script = _common.console_script("unmix-demo-scene")
    _common.run_command([script, str(folder / "scene"), "--size", size, "--bands", "16", "--views", "24"])
    words = ["--data", str(folder / "scene"), "--output-dir", str(folder / "outputs")]
    script = _common.console_script("unmix-train")
    return _common.run_command([script, "unmix-nerf", *words, "--max-seconds", f"{seconds:g}"]).run


def pictures(run: Path, splats: Path, packages: Path, chromium: str) -> dict[str, dict[str, float]]:
    """PlayCanvas's picture of each format against ours."""
    from playwright.sync_api import sync_playwright

    from unmix_plugin.trained.open_run import open_run

    scene = open_run(run, "cpu")
    view = next(view for view in scene.views if view.split == "eval")
    width, height = 512, round(512 * view.camera.height / view.camera.width)
    camera = view.camera.resized(width, height)
    seen = scene.look(camera)
    ours, is_object = seen["rgb"].numpy(), seen.opacity.numpy() > 0.5
    files = {"/playcanvas.mjs": packages / "playcanvas" / "build" / "playcanvas.mjs"}
    files |= {f"/splats.{kind}": splats / f"splats.{kind}" for kind in ("ply", "glb")}
    page = page_of(scene, camera)

    def serve(route: Any) -> None:
        path = route.request.url.removeprefix("http://splats.test").partition("?")[0]
        if path == "/":
            route.fulfill(body=page, content_type="text/html")
        elif path in files:
            kind = "text/javascript" if path.endswith(".mjs") else "application/octet-stream"
            route.fulfill(body=files[path].read_bytes(), content_type=kind)
        else:
            route.abort()

    found = {}
    with sync_playwright() as session:
        browser = session.chromium.launch(executable_path=chromium, args=list(SOFTWARE_GL))
        for kind in ("ply", "glb"):
            opened = browser.new_page(viewport={"width": width, "height": height})
            opened.on("console", lambda message: print("the browser says:", message.text))
            opened.route("**/*", serve)
            opened.goto(f"http://splats.test/?kind={kind}")
            opened.wait_for_function("window.shown || window.failed", timeout=300_000)
            if opened.evaluate("window.failed"):
                raise SystemExit(f"PlayCanvas can't load the {kind}: {opened.evaluate('window.failed')}")
            data = base64.b64decode(opened.evaluate("window.shown").split(",")[1])
            theirs = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255
            squares = np.square(theirs - ours)
            found[kind] = {
                "splats": opened.evaluate("window.count"),
                "psnr": float(-10 * np.log10(squares.mean())),
                "psnr_object": float(-10 * np.log10(squares[is_object].mean())),
            }
            opened.close()
        browser.close()
    return found


def page_of(scene: Any, camera: Any) -> str:
    """A page that shows the splats through a camera, world axes."""
    from unmix_plugin.trained.run_views import directions_to_world

    pose = camera.camera_to_world[0].double().numpy()
    place = scene.frame.to_world(pose[None, :, 3])[0]
    axes = directions_to_world(scene.frame, pose[:, :3].T)
    columns = [[*axis, 0.0] for axis in axes.tolist()] + [[*place.tolist(), 1.0]]
    size = 4 / scene.frame.scale
    values = {
        "POSE": json.dumps([number for column in columns for number in column]),
        "FOV": f"{np.degrees(2 * np.arctan(camera.height / 2 / float(camera.focal_px[0, 1])))}",
        "WIDTH": str(camera.width),
        "HEIGHT": str(camera.height),
        "NEAR": f"{size / 1000}",
        "FAR": f"{4 * size}",
    }
    page = PAGE
    for name, text in values.items():
        page = page.replace(name, text)
    return page


def table(folder: Path, packages: Path) -> dict[str, Any]:
    """What SuperSplat's reader takes from the PLY, against another reader."""
    words = [shutil.which("node") or "node", str(packages / ".bin" / "splat-transform"), "-w"]
    written = folder / "splats.csv"
    _common.run_command([*words, str(folder / "z" / "splats.ply"), str(written)])
    with written.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    ours = PlyData.read(folder / "z" / "splats.ply")["vertex"]
    names = ["x", "y", "z", "opacity", *(f"{name}_{i}" for name in ("f_dc", "scale") for i in range(3))]
    names += [f"rot_{index}" for index in range(4)]
    off = {
        name: float(np.abs(np.array([float(row[name]) for row in rows]) - np.asarray(ours[name])).max())
        for name in names
    }
    return {"splats": len(rows), "columns": list(rows[0]), "largest_difference": off}


def validated(path: Path, packages: Path) -> dict[str, Any]:
    """What the Khronos validator counts and says of a file."""
    script = (
        "const [,, where, path] = process.argv;"
        "require(where).validateBytes(new Uint8Array(require('fs').readFileSync(path)))"
        ".then((found) => console.log(JSON.stringify(found.issues)))"
    )
    words = ["node", "-e", script, "x", str(packages / "gltf-validator"), str(path)]
    found = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    unknown = [
        one for one in found["messages"] if "KHR_gaussian_splatting" in one["pointer"] + one["message"]
    ]
    errors = found["numErrors"] - sum(one["severity"] == 0 for one in unknown)
    codes = sorted({one["code"] for one in found["messages"] if one not in unknown})
    codes += [f"and {len(unknown)} on KHR_gaussian_splatting, which it does not know"] if unknown else []
    return {"errors": errors, "warnings": found["numWarnings"], "codes": codes}


def judge(measured: dict[str, Any]) -> list[_common.Figure]:
    """What is asked of each file."""
    mesh, splats = measured["validator"]["mesh"], measured["validator"]["splats"]
    off = max(measured["table"]["largest_difference"].values())
    return [
        *(
            _common.reported(
                f"PSNR of PlayCanvas's picture of splats.{kind} against ours",
                f"{found['psnr']:.1f} dB, of the object alone {found['psnr_object']:.1f} dB",
            )
            for kind, found in measured["pictures"].items()
        ),
        _common.required(
            "splats that PlayCanvas and SuperSplat's reader find",
            "all",
            len({*(one["splats"] for one in measured["pictures"].values()), measured["table"]["splats"]})
            == 1,
            str(measured["table"]["splats"]),
        ),
        _common.required(
            "numbers in SuperSplat's reader",
            "within 1e-4",
            off < 1e-4,
            f"within {off:.1g}" if off else "the same",
        ),
        *(
            _common.required(
                f"Khronos validator, {name}.glb",
                "0 errors, 0 warnings",
                found["errors"] == found["warnings"] == 0,
                f"{found['errors']} errors, {found['warnings']} warnings; {', '.join(found['codes']) or 'no note'}",
            )
            for name, found in (("mesh", mesh), ("splats", splats))
        ),
    ]


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
