"""How large is the exported page, how soon does it show something, and does it show what `unmix-render` shows?

    python benchmarks/page.py [--runs RUN ...]

Trains on two scenes and on neumatex's built-in object (or takes runs that are there), exports the page of each, and
opens it from its file in Chromium, which draws by software here: a graphics processor is many times faster. So the
time to the first picture is given in two parts: until all is read, computed and handed over to be drawn, which is the
page's own work, and until it is drawn. Each layer is compared with the render of the same camera, as colours
(CIEDE2000), where the object is and away from its edges.
"""

from __future__ import annotations

import base64
import io
import shutil
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import _common
import _machine
import numpy as np
import tyro
from other_viewers import SOFTWARE_GL
from PIL import Image

SIZE = _common.Limit(20.0, is_upper=True, unit=" MB")
FIRST = _common.Limit(3.0, is_upper=True, unit=" s")
DIFFERENCE = _common.Limit(3.0, is_upper=True)
SIDE = 160
"""Of the pictures that are compared."""
SIZES = {"1440 x 900": (1440, 900), "390 x 844": (390, 844)}
"""Of windows in which frames are counted: a laptop's, in which the page is opened, and a phone's."""
FRAMES = 10
FRAME = """const frame = () => {
  const gl = document.querySelector('canvas').getContext('webgl2');
  unmixPage.draw();
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
};"""
"""Draws, and waits until it is drawn."""
WATCH = """let page;
Object.defineProperty(window, 'unmixPage', { get: () => page, set: (value) => {
  page = value;
  const ready = performance.now();
  %s
  frame();
  window.timed = { ready, drawn: performance.now() };
} });"""
"""Runs before the page does; times are since it was opened."""


@dataclass(frozen=True)
class Options:
    """Measure exported pages."""

    runs: tuple[Path, ...] = ()
    """Runs to export from, in place of training."""
    max_seconds: float = 60.0
    """Seconds of each training."""
    results: Path | None = None
    """Folder for page.json and page.md; None: beside the benchmarks."""
    quick: bool = False
    """A small built-in scene alone, trained for two seconds."""


def main(options: Options) -> None:
    """Train, export, open, compare, publish."""
    from playwright.sync_api import sync_playwright

    machine = _machine.describe_machine()
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        print(
            "nothing measured: needs the program chromium (scripts/install_system_packages.sh)",
            file=sys.stderr,
        )
        raise SystemExit(2)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="unmix-page-")))
        session = stack.enter_context(sync_playwright())
        browser = session.chromium.launch(executable_path=chromium, args=list(SOFTWARE_GL))
        stack.callback(browser.close)
        measured = {}
        for run in options.runs or trained(options, folder):
            name = f"{run.parents[1].name} ({run.parent.name})"
            print(f"{name} ...", flush=True)
            script, output = _common.console_script("unmix-export"), folder / str(len(measured))
            ended = _common.run_command([script, "page", "--run", str(run), "--output", str(output)])
            measured[name] = measure(run, output / "page.html", browser) | {"export_seconds": ended.seconds}
    setting = {"pages": list(measured), "side of compared pictures": SIDE, "window": "1440 x 900"}
    question = "The exported page: size, time to the first picture, and layers against renders"
    report = _common.Report("page", question, setting, machine, judge(measured), measured)
    _common.publish(report, _common.results_folder(options.results, options.quick))


def trained(options: Options, folder: Path) -> list[Path]:
    """A run of each scene."""
    scenes = [("unmix-nerf", _common.cached_scene(name)) for name in ("table", "pots")]
    jobs = [*scenes, ("neumatex", Path("demo-object"))]
    seconds = options.max_seconds
    if options.quick:
        script = _common.console_script("unmix-demo-scene")
        _common.run_command([script, str(folder / "scene"), "--size", "32", "--bands", "8", "--views", "8"])
        jobs, seconds = [("unmix-nerf", folder / "scene")], 2.0
    else:
        _common.require_scenes(*(scene for _, scene in scenes))
    script = _common.console_script("unmix-train")
    rest = ["--output-dir", str(folder / "outputs"), "--max-seconds", f"{seconds:g}"]
    return [_common.run_command([script, method, "--data", str(data), *rest]).run for method, data in jobs]


def measure(run: Path, path: Path, browser: Any) -> dict[str, Any]:
    """Size, times, and differences of layers."""
    from unmix_plugin.trained.open_run import load_run

    (width, height), *_ = SIZES.values()
    page = browser.new_page(viewport={"width": width, "height": height})
    page.on("console", lambda message: print("the page says:", message.text))
    page.add_init_script(WATCH % FRAME)
    page.goto(path.as_uri(), timeout=300_000)
    page.wait_for_function("window.timed", timeout=300_000)
    timed = page.evaluate("timed")
    triangles = page.evaluate("unmixPage.facts.arrays.faces.count / 3")
    rates = {}
    for name, (width, height) in SIZES.items():
        page.set_viewport_size({"width": width, "height": height})
        frame_ms = page.evaluate(
            f"(() => {{ {FRAME} frame(); const from = performance.now();"
            f"for (let i = 0; i < {FRAMES}; i++) frame(); return (performance.now() - from) / {FRAMES}; }})()"
        )
        rates[name] = 1000 / frame_ms
    page.set_viewport_size({"width": SIDE, "height": SIDE})
    page.evaluate("unmixPage.fold()")  # else the object stands beside the panel
    scene = load_run(run, "cpu").scene
    view = next(view for view in scene.views if view.split == "eval")
    names = "unmixPage.facts.cameras.findIndex"
    page.evaluate(f"unmixPage.lookThrough({names}((one) => one.name === '{view.name}'))")
    differences = {
        layer: difference(truth, picture(page, layer), inside)
        for layer, truth, inside in expected(scene, view.camera.resized(SIDE, SIDE), page)
    }
    page.close()
    return {
        "megabytes": path.stat().st_size / 1e6,
        "triangles": triangles,
        "ready_s": timed["ready"] / 1000,
        "first_picture_s": timed["drawn"] / 1000,
        "frames_per_second": rates,
        "differences": differences,
    }


def picture(page: Any, layer: str) -> np.ndarray:
    """What the canvas shows of a layer, sRGB in [0, 1]."""
    page.evaluate(f"unmixPage.choose('{layer}')")
    url = page.evaluate("(unmixPage.draw(), document.querySelector('canvas').toDataURL())")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB")) / 255


def difference(truth: np.ndarray, shown: np.ndarray, inside: np.ndarray) -> float:
    """Median CIEDE2000."""
    from skimage.color import deltaE_ciede2000, rgb2lab

    return float(np.median(deltaE_ciede2000(rgb2lab(truth), rgb2lab(shown))[inside]))


def expected(scene: Any, camera: Any, page: Any) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Layers of the page with what renders say of them, and where to compare."""
    import torch
    from matplotlib import colormaps
    from scipy.ndimage import binary_erosion

    from unmix_plugin.spectral.colour.conversion import linear_to_srgb

    def srgb(linear: torch.Tensor) -> np.ndarray:
        return linear_to_srgb(linear.clamp(0, 1)).cpu().numpy()

    def mapped(values: torch.Tensor) -> np.ndarray:
        return colormaps["viridis"](values.cpu().numpy())[..., :3]

    seen = scene.look(camera)
    opacity = seen.opacity
    inside = binary_erosion(opacity.cpu().numpy() > 0.97, iterations=3)
    found = [("colour", seen["rgb"].cpu().numpy())]
    if not hasattr(scene, "materials"):
        found += [("base", srgb(seen["base_colour"]))]
        if "roughness" in {output.name for output in scene.outputs}:
            found += [("roughness", mapped(seen["roughness"]))]
        return [(layer, truth, inside) for layer, truth in found]
    nm = page.evaluate("unmixPage.facts.wavelengths_nm[unmixPage.state.band]")
    red, green, blue = page.evaluate("unmixPage.state.false.map((b) => unmixPage.facts.wavelengths_nm[b])")
    bands = {number: seen[f"band:{number}nm"] for number in {nm, red, green, blue}}
    colours = np.array(page.evaluate("unmixPage.facts.colours"))
    ids = np.minimum(seen["segmentation"].cpu().numpy(), len(colours) - 1)
    found += [
        ("band", srgb(bands[nm][..., None].expand(-1, -1, 3))),
        ("false", srgb(torch.stack([bands[red], bands[green], bands[blue]], dim=-1))),
        ("abundance", mapped(seen["abundances"][..., 0] / opacity.clamp(min=1e-6))),
        ("materials", colours[ids]),
        ("confidence", mapped(scene.materials.confidence(seen.coefficients))),
    ]
    return [(layer, truth, inside) for layer, truth in found]


def judge(measured: dict[str, dict[str, Any]]) -> list[_common.Figure]:
    """What is asked of each page."""
    figures = []
    for name, found in measured.items():
        figures += [
            SIZE.judge(f"{name}: size", found["megabytes"]),
            FIRST.judge(
                f"{name}: first picture, {found['triangles']:.0f} triangles", found["first_picture_s"]
            ),
            _common.reported(f"{name}: of that until all is ready to be drawn", f"{found['ready_s']:.2f} s"),
            *(
                _common.reported(f"{name}: frames/s at {size}, drawn by software", f"{rate:.1f}")
                for size, rate in found["frames_per_second"].items()
            ),
            *(
                DIFFERENCE.judge(f"{name}: layer {layer}, median CIEDE2000", value)
                for layer, value in found["differences"].items()
            ),
        ]
    return figures


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
