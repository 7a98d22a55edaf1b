"""Makes the pictures of docs/pictures: `python scripts/gallery.py [NAME ...]`.

The scenes table, pots and turntable are those of `make scenes`; the built-in scene is made here. Each is trained once,
for `--seconds`, into `--work`, where runs of `quality.py --runs WORK/runs` do as well. Names choose pictures,
all by default. Pictures of browsers need chromium.
"""

from __future__ import annotations

import argparse
import io
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from unmix_plugin import Cameras, Light, MaterialView, Recipe, TrainedScene, edit_scene, open_run, train
from unmix_plugin.commands.export import export
from unmix_plugin.editing import Operation, Remove, Rename, Replace, Retint
from unmix_plugin.engine.geometry.camera_paths import orbit
from unmix_plugin.engine.outputs import Output
from unmix_plugin.figures.paint import paint
from unmix_plugin.scenes.demo.scene import make_demo_scene
from unmix_plugin.spectral.colour.conversion import linear_to_srgb
from unmix_plugin.trained.run_materials import endmember_colours
from unmix_plugin.trained.run_views import cameras_of

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))
from benchmarks import _common  # noqa: E402 - of the repository, in no wheel

PICTURES = ROOT / "docs/pictures"
NDVI = Output("index:ndvi", "map", "NDVI", "NDVI", (-0.1, 0.9), "RdYlGn")
INK, SOFT = "#1f2328", "#656d76"


class Studio:
    """Where scenes are, and the runs of them."""

    def __init__(self, scenes: Path | None, work: Path, seconds: float) -> None:
        self.scenes, self.work, self.seconds = scenes, work, seconds
        self._opened: dict[str, TrainedScene] = {}

    def data(self, name: str) -> Path:
        """A scene's folder."""
        if name != "demo":
            [folder] = _common.scene_folders(self.scenes, (name,))
            return folder
        folder = self.work / "scenes/demo"
        if not folder.exists():
            make_demo_scene(folder, 192, 31, 40)
        return folder

    def run(self, name: str) -> Path:
        """The newest run of a scene, trained if there is none."""
        found = sorted((self.work / "runs" / name / "unmix-nerf").glob("*/"))
        if found:
            return found[-1]
        data = self.data(name)
        num_endmembers = len(_table(data / "endmembers.csv")[0])
        train(data, output_dir=self.work / "runs", max_seconds=self.seconds, endmembers=num_endmembers)
        return self.run(name)

    def named(self, name: str) -> list[str]:
        """Options of a command for a run whose endmembers have names."""
        self.scene(name)
        return ["--run", str(self.run(name)), "--edits", str(self.work / f"{name}.yml")]

    def scene(self, name: str) -> TrainedScene:
        """A trained scene whose endmembers have the names of the true materials that they are nearest to."""
        if name not in self._opened:
            scene = open_run(self.run(name))
            true_names, truth = _table(self.data(name) / "endmembers.csv")
            _, power = _table(self.data(name) / "illuminant.csv")
            found = scene.materials.endmembers.double().cpu().numpy()
            cosine = _unit(found) @ _unit(truth * power).T
            nearest = [true_names[column].replace("_", " ") for column in cosine.argmax(axis=1)]
            names = []
            for row, material in enumerate(nearest):  # two endmembers may be one material in truth
                count = nearest[: row + 1].count(material)
                names.append(Rename(row, material if count == 1 else f"{material} {count}"))
            self._opened[name] = edit_scene(scene, Recipe(tuple(names)))
            lines = [f"  - rename: {{endmember: {edit.endmember}, name: {edit.name}}}" for edit in names]
            (self.work / f"{name}.yml").write_text("\n".join(["edits:", *lines, ""]))
        return self._opened[name]


def _table(path: Path) -> tuple[list[str], np.ndarray]:
    """Names of a CSV's columns after the first, and their values as rows."""
    names = path.read_text().splitlines()[0].split(",")[1:]
    return names, np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2).T[1:]


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def colour(view: MaterialView) -> np.ndarray:
    """True colour on white."""
    light = view["linear_rgb"].cpu() + (1 - view["accumulation"].cpu().clamp(0, 1))[..., None]
    return linear_to_srgb(light.clamp(0, 1)).numpy()


def materials(view: MaterialView, colours: np.ndarray) -> np.ndarray:
    """The material of each pixel in its colour, shaded a little by the normals, on white."""
    painted = colours[view["segmentation"].cpu().numpy().clip(0, len(colours) - 1)]
    return on_white(painted, view)


def infrared(view: MaterialView) -> np.ndarray:
    """Near infrared, red and green shown as red, green and blue, on white."""
    light = (
        view["false-colour:860,650,550"].cpu() * 1.4 + (1 - view["accumulation"].cpu().clamp(0, 1))[..., None]
    )
    return linear_to_srgb(light.clamp(0, 1)).numpy()


def share(view: MaterialView, number: int) -> np.ndarray:
    """The abundance of a material on white."""
    return on_white(plt.get_cmap("viridis")(view["abundances"].cpu().numpy()[..., number])[..., :3], view)


def index(view: MaterialView, output: Output) -> np.ndarray:
    """An index on white."""
    return paint(output, view[output.name], view.opacity).picture(1.0)


def on_white(picture: np.ndarray, view: MaterialView) -> np.ndarray:
    """Something that is not multiplied by opacity, laid over white."""
    part = view["accumulation"].cpu().clamp(0, 1).numpy()[..., None]
    return picture * part + 1 - part


def look(
    scene: TrainedScene, camera: Cameras, width: int, height: int, zoom: float = 1.0, subpixels: int = 2
) -> MaterialView:
    """A view of another size, closer by `zoom`."""
    camera = camera.resized(width, height)
    return scene.look(replace(camera, focal_px=camera.focal_px * zoom), subpixels)


def evaluation(scene: TrainedScene, number: int) -> Cameras:
    """An evaluation view's camera."""
    return [view.camera for view in scene.views if view.split == "eval"][number]


def trimmed(pictures: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Pictures of one size less the rows at top and bottom in which all are white."""
    matter = np.stack([(picture < 0.97).any(axis=(1, 2)) for picture in pictures]).any(axis=0)
    rows = np.flatnonzero(matter)
    top, bottom = max(rows[0] - 6, 0), rows[-1] + 7
    return [picture[top:bottom] for picture in pictures]


def panels(
    path: Path,
    rows: Sequence[Sequence[tuple[str, np.ndarray]]],
    legend: Sequence[tuple[str, Sequence[float]]] = (),
) -> None:
    """Writes pictures with captions in rows, with names and colours below, as a PNG of few colours."""
    cut = iter(trimmed([picture for row in rows for _, picture in row]))
    rows = [[(title, next(cut)) for title, _ in row] for row in rows]
    height, width, _ = rows[0][0][1].shape
    columns = max(len(row) for row in rows)
    inches = 11.0
    side = inches / columns
    tall = len(rows) * (side * height / width + 0.3) + (0.42 if legend else 0.05)
    figure = plt.figure(figsize=(inches, tall), facecolor="white")
    for line, row in enumerate(rows):
        top = tall - line * (side * height / width + 0.3)
        for column, (title, picture) in enumerate(row):
            box = (
                column / columns,
                (top - 0.3 - side * height / width) / tall,
                0.99 / columns,
                side * height / width / tall,
            )
            axes = figure.add_axes(box)
            axes.imshow(picture.clip(0, 1), aspect="auto", interpolation="lanczos")
            axes.set_axis_off()
            figure.text(column / columns + 0.01, (top - 0.22) / tall, title, fontsize=12, color=INK)
    _legend(figure, legend, 0.12 / tall)
    save(figure, path)


def _legend(figure: Figure, legend: Sequence[tuple[str, Sequence[float]]], base: float) -> None:
    place = 0.012
    for name, shade in legend:
        figure.text(place, base, "■", color=tuple(shade), fontsize=15, va="baseline")
        text = figure.text(place + 0.02, base, name, color=SOFT, fontsize=12, va="baseline")
        place = text.get_window_extent().x1 / figure.bbox.width + 0.025


def save(figure: Figure, path: Path) -> None:
    """A figure as a PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, facecolor="white")
    plt.close(figure)
    Image.open(buffer).convert("RGB").save(path, optimize=True)


def make_orbit(studio: Studio) -> None:
    """Potted plants going round: as the eye sees them, with infrared, as materials."""
    scene = studio.scene("pots")
    colours = endmember_colours(scene.materials)
    cameras = orbit(cameras_of(scene.views, "train"), scene.scene_box, 40)
    frames = []
    for number in range(len(cameras)):
        view = look(scene, cameras[number], 300, 270, 0.94, 1)
        tiles = np.concatenate([colour(view), infrared(view), materials(view, colours)], axis=1)
        frames.append(Image.fromarray((tiles.clip(0, 1) * 255).round().astype(np.uint8)))
    frames[0].save(
        PICTURES / "orbit.webp",
        save_all=True,
        append_images=frames[1:],
        duration=100,
        loop=0,
        quality=78,
        method=6,
    )


def make_measured(studio: Studio) -> None:
    """Views that training never saw, predicted and measured."""
    scene, data = studio.scene("demo"), studio.data("demo")
    colours = endmember_colours(scene.materials)
    names = scene.materials.names
    rows = []
    for number in (1, 6):
        run_view = [view for view in scene.views if view.split == "eval"][number]
        view = scene.look(run_view.camera, 2)
        picture = (
            np.asarray(Image.open(next((data / "images").glob(f"{run_view.name}.png"))).convert("RGBA")) / 255
        )
        measured = picture[..., :3] * picture[..., 3:] + 1 - picture[..., 3:]
        rows.append(
            [
                ("measured", measured),
                ("predicted", colour(view)),
                ("materials", materials(view, colours)),
                ("share of white", share(view, names.index("white"))),
            ]
        )
    panels(PICTURES / "predicted.png", rows, list(zip(names, colours, strict=True)))


def make_materials(studio: Studio) -> None:
    """What a scene is made of: its materials, their spectra, and where each is."""
    scene = studio.scene("table")
    colours, names = endmember_colours(scene.materials), scene.materials.names
    view = look(scene, evaluation(scene, 6), 400, 330, 1.1)
    figure = plt.figure(figsize=(11, 5.6), facecolor="white")
    for left, picture, title in (
        (0.0, colour(view), "the scene from a new viewpoint"),
        (0.32, materials(view, colours), "the materials found in it"),
    ):
        axes = figure.add_axes((left, 0.5, 0.31, 0.45))
        axes.imshow(trimmed([picture])[0].clip(0, 1), interpolation="lanczos")
        axes.set_axis_off()
        figure.text(left + 0.01, 0.96, title, fontsize=12, color=INK)
    chart = figure.add_axes((0.69, 0.56, 0.29, 0.38))
    for name, shade, spectrum in zip(names, colours, scene.materials.endmembers.cpu().numpy(), strict=True):
        chart.plot(scene.bands.centers_nm, spectrum, color=shade, linewidth=2.2, label=name)
    chart.spines[["top", "right"]].set_visible(False)
    chart.set(xlabel="wavelength (nm)", ylabel="radiance", xlim=(400, 700), ylim=(0, None))
    figure.text(0.66, 0.96, "their spectra (endmembers)", fontsize=12, color=INK)
    for number, name in enumerate(names):
        left, width = number / len(names), 1 / len(names)
        axes = figure.add_axes((left, 0.1, width, 0.26))
        axes.imshow(trimmed([share(view, number)])[0], interpolation="lanczos")
        axes.set_axis_off()
        figure.text(left + 0.01, 0.37, "■", color=tuple(colours[number]), fontsize=15)
        figure.text(left + 0.03, 0.373, name, color=INK, fontsize=12)
    figure.text(0.01, 0.45, "the share of each (abundances)", fontsize=12, color=INK)
    ramp = figure.add_axes((0.01, 0.07, 0.2, 0.02))
    ramp.imshow(np.linspace(0, 1, 64)[None], aspect="auto", cmap="viridis")
    ramp.set(yticks=[], xticks=[0, 63], xticklabels=["0", "1"])
    ramp.tick_params(length=0)
    save(figure, PICTURES / "materials.png")


def make_plant(studio: Studio) -> None:
    """A plant on a turntable: what the eye sees, what the infrared adds, an index, materials."""
    scene = studio.scene("turntable")
    view = look(scene, evaluation(scene, 3), 330, 330, 1.0)
    colours = endmember_colours(scene.materials)
    row = [
        ("true colour", colour(view)),
        ("infrared shown as red", infrared(view)),
        ("NDVI", index(view, NDVI)),
        ("materials", materials(view, colours)),
    ]
    panels(PICTURES / "plant.png", [row], list(zip(scene.materials.names, colours, strict=True)))


def make_lights(studio: Studio) -> None:
    """One scene in four lights."""
    scene = studio.scene("table")
    camera = evaluation(scene, 0)
    row = []
    for name, title in (
        ("D65", "daylight (D65)"),
        ("A", "incandescent (A)"),
        ("FL2", "fluorescent (FL2)"),
        ("HP1", "sodium lamp (HP1)"),
    ):
        lit = edit_scene(scene, Recipe(illuminant=Light(name)))
        row.append((title, colour(look(lit, camera, 360, 300, 0.95))))
    panels(PICTURES / "lights.png", [row])


def make_edits(studio: Studio) -> None:
    """Materials changed: the run stays as it is."""
    scene = studio.scene("table")
    camera = evaluation(scene, 0)
    recipes: list[tuple[str, tuple[Operation, ...]]] = [
        ("as it was taken", ()),
        ("blue recoloured", (Retint("blue flower", (0.85, 0.55, 0.1)),)),
        ("red replaced", (Replace("red", "ColorChecker/foliage"),)),
        ("white removed", (Remove(("white card",)),)),
    ]
    row = [
        (title, colour(look(edit_scene(scene, Recipe(edits)), camera, 360, 300, 0.95)))
        for title, edits in recipes
    ]
    panels(PICTURES / "edits.png", [row])


@contextmanager
def browser_page(width: int, height: int) -> Iterator[Any]:
    """A page in Chromium that can draw in 3-D."""
    from playwright.sync_api import sync_playwright

    program = shutil.which("chromium") or shutil.which("chromium-browser")
    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as session:
        browser = session.chromium.launch(executable_path=program, args=flags)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(120_000)
        yield page
        browser.close()


def make_page(studio: Studio) -> None:
    """The page to share, with two points probed."""
    folder = studio.work / "page"
    export(
        [
            "page",
            *studio.named("pots"),
            "--output",
            str(folder),
            "--title",
            "Potted plants",
            "--overwrite",
        ]
    )
    with browser_page(1180, 720) as page:
        page.goto((folder / "page.html").resolve().as_uri())
        page.wait_for_function("window.unmixPage")
        page.wait_for_timeout(3000)
        for x, y in ((375, 320), (430, 490)):
            page.mouse.click(x, y)
            page.wait_for_timeout(1500)
        page.screenshot(path=str(PICTURES / "page.png"))


def make_viewer(studio: Studio) -> None:
    """The viewer with a pixel probed."""
    from unmix_plugin.commands.view import ViewOptions, prepared
    from unmix_plugin.viewer.access import ViewerOptions

    _, run, _, names = studio.named("table")
    served = prepared(
        ViewOptions(run=Path(run), edits=Path(names), device="cpu", viewer=ViewerOptions(port=0))
    )
    served.start()
    with browser_page(1180, 760) as page:
        page.goto(f"http://127.0.0.1:{served.port}")
        page.get_by_role("tab", name="probe").wait_for()
        page.wait_for_timeout(8000)
        page.add_style_tag(
            content=".mantine-Notification-root { display: none }"
        )  # of a machine without a GPU
        page.get_by_role("tab", name="probe").click()
        page.wait_for_timeout(1000)
        page.mouse.click(390, 420)
        page.wait_for_timeout(15000)
        page.screenshot(path=str(PICTURES / "viewer.png"))
    served.stop()


MAKERS: dict[str, Callable[[Studio], None]] = {
    "orbit": make_orbit,
    "predicted": make_measured,
    "materials": make_materials,
    "plant": make_plant,
    "lights": make_lights,
    "edits": make_edits,
    "page": make_page,
    "viewer": make_viewer,
}


def main() -> None:
    """Console entry."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*MAKERS, []], help="pictures to make; all by default")
    parser.add_argument(
        "--scenes", type=Path, help="folder of the scenes; by default where make scenes writes them"
    )
    parser.add_argument("--work", type=Path, default=Path("outputs/gallery"), help="where runs are kept")
    parser.add_argument("--seconds", type=float, default=175.0, help="length of each training")
    given = parser.parse_args()
    studio = Studio(given.scenes, given.work, given.seconds)
    for name in given.names or MAKERS:
        began = time.monotonic()
        MAKERS[name](studio)
        print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
