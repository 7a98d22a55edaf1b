"""A scene of a method without endmembers: whatever it can show is written, in every format that suits it."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.factories.outputs import read_video
from tests.factories.renders import read_envi, read_exr, views
from unmix_plugin.engine.geometry.space import SceneBox
from unmix_plugin.engine.outputs import WORLD_UNITS, Output
from unmix_plugin.errors import ConfigError
from unmix_plugin.figures.look import Look
from unmix_plugin.figures.paint import legend_of
from unmix_plugin.products.render.files import choose_formats, needs_legend, still_paths, with_units
from unmix_plugin.products.render.job import RenderJob, output_paths, take_survey
from unmix_plugin.products.render.maps import MapInfo
from unmix_plugin.products.render.pictures import draw_legend
from unmix_plugin.trained.protocol import RenderableScene

pytestmark = pytest.mark.usefixtures("no_wait_for_the_disk")

OUTPUTS = (
    Output("rgb", "srgb", "colour", "sRGB on black"),
    Output("heat", "map", "heat", "temperature in K"),
    Output("classes", "labels", "classes", "class, 255 where nothing is"),
    Output("likelihood", "shares", "likelihood", "likelihood of each class", (0.0, 1.0)),
    Output("filters", "channels", "filters", "light through each filter"),
    Output(
        "bands",
        "channels",
        "bands",
        "light of each band",
        centers_nm=(450.0, 550.0, 650.0),
        quantity="reflectance",
        is_on_black=True,
    ),
    Output("reach", "map", "reach", "how far it is", unit=WORLD_UNITS, nothing=0),
    Output("normals", "vectors", "normals", "unit normals"),
)
CHANNELS = {"rgb": 3, "likelihood": 4, "filters": 7, "bands": 3, "normals": 3}


@dataclass(frozen=True)
class Glow:
    """What a camera sees: numbers that follow from the row and the column."""

    camera: Any

    @property
    def opacity(self):
        return torch.ones(self.camera.height, self.camera.width)

    @property
    def coverage(self):
        return self.opacity

    def __getitem__(self, name):
        rays = self.camera.image_rays(0).directions.unflatten(0, (self.camera.height, self.camera.width))
        if name == "classes":
            return (rays[..., 0] > 0).to(torch.uint8)
        if name == "reach":
            return rays[..., 0].abs() + 1
        if name == "heat":
            return 300 + 10 * rays[..., 0]
        return rays[..., :1].abs().expand(-1, -1, CHANNELS[name]).contiguous()


@dataclass(frozen=True)
class GlowScene:
    """The small protocol and nothing more."""

    outputs: tuple[Output, ...] = OUTPUTS
    scene_box: SceneBox = field(default_factory=lambda: SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])))
    frame: Any = None
    views: tuple[Any, ...] = ()
    device: torch.device = torch.device("cpu")
    notes: tuple[str, ...] = ()
    bands: Any = None
    materials: Any = None
    pixel_size: float | None = None
    fitted: tuple[Any, ...] = ()

    @property
    def lit_head_on(self):
        return self

    def output(self, name):
        for output in self.outputs:
            if output.name == name:
                return output
        raise ConfigError(f"there is no output named {name!r}")

    def look(self, camera, subpixels=None):
        return Glow(camera)

    def render(self, camera, names):
        return {name: Glow(camera)[name] for name in names}

    def probe(self, camera, column, row):
        raise NotImplementedError


SCENE = GlowScene()


@pytest.mark.parametrize("is_path", [False, True])
def test_everything_that_it_shows_is_written_in_every_format(tmp_path, is_path):
    assert isinstance(SCENE, RenderableScene)
    cameras = views(2, is_path=is_path)
    outputs = choose_formats(["all"], ["npy", "envi", "exr", "png", "mp4"], SCENE, is_path)
    survey = take_survey(SCENE, cameras.views, [one.output for one in outputs])
    assert 290 < survey.ranges["heat"][0] < survey.ranges["heat"][1] < 310
    job = RenderJob(SCENE, cameras, outputs, survey, tmp_path)
    job.render(job.blocks(30))
    for one in outputs:
        assert all(path.is_file() for path in output_paths(tmp_path, one, cameras))
        if needs_legend(one, SCENE):
            legend = legend_of(one.output, survey.ranges.get(one.output.name), Look())
            assert len(draw_legend(one.output, legend)) > 1000
    for one in outputs:
        if one.format == "npy":
            [path] = still_paths(tmp_path, one, "view.1")
            expected = Glow(cameras.views[1].camera)[one.output.name].numpy()
            np.testing.assert_allclose(np.load(path), expected, atol=1e-4)
    numbers, header = read_envi(tmp_path / "filters" / "view.0")
    assert numbers.shape == (11, 14, 7)
    assert header["band names"][6] == "filters 6"
    assert set(read_exr(tmp_path / "likelihood" / "view.0.exr")) == {
        f"likelihood.likelihood {n}" for n in range(4)
    }
    assert len(read_video(tmp_path / "heat.mp4")[0]) == 2


REWORDED = tuple(replace(one, title="x", label="x", remarks=()) for one in OUTPUTS)


@pytest.mark.parametrize("outputs", [OUTPUTS, REWORDED])
def test_what_files_say_of_numbers_follows_from_fields_whatever_the_words_are(tmp_path, outputs):
    scene, cameras = GlowScene(outputs), replace(views(1), map_info=MapInfo(0.0, 0.0, 1.0, 0.01))
    chosen = choose_formats(["bands", "reach"], ["npy", "envi", "exr", "tif"], scene, False)
    asked = with_units(chosen, cameras.map_info)
    survey = take_survey(scene, cameras.views, [one.output for one in asked], cameras.map_info)
    job = RenderJob(scene, cameras, asked, survey, tmp_path)
    job.render(job.blocks())
    numbers, header = read_envi(tmp_path / "bands" / "view.0")
    assert [float(nm) for nm in header["wavelength"]] == [450.0, 550.0, 650.0]
    assert numbers.shape[2] == 3
    assert set(read_exr(tmp_path / "bands" / "view.0.exr")) >= {f"T.{nm},000000nm" for nm in (450, 550, 650)}
    tags = (tmp_path / "bands" / "view.0.tif").read_bytes()
    assert all(f">{nm}<".encode() in tags for nm in (450, 550, 650))
    own = Glow(cameras.views[0].camera)["reach"].numpy()
    np.testing.assert_allclose(np.load(tmp_path / "reach" / "view.0.npy"), 0.01 * own, rtol=1e-6)
    _, header = read_envi(tmp_path / "reach" / "view.0")
    assert header["data ignore value"] == "0"
    assert "in metres" in header["description"]


def test_without_a_wish_it_gets_what_is_usual_of_what_it_has():
    assert {one.output.name for one in choose_formats([], [], SCENE, False)} == {"rgb"}
    odd = GlowScene(OUTPUTS[1:3])
    assert {one.output.name for one in choose_formats([], [], odd, True)} == {"heat", "classes"}
