"""The page of a ball that is known exactly, with regions that are kept."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from tests.factories.ball_model import ALL_ROUND, RADIUS, ball_scene, cameras_around, few_rays
from tests.factories.cameras import FRAME
from unmix_plugin.engine.processes import ALONE
from unmix_plugin.products.page import page
from unmix_plugin.products.product import Job
from unmix_plugin.trained.measures import Measures, Scale
from unmix_plugin.trained.regions import Box, OfMaterial
from unmix_plugin.trained.run_views import RunView

MIDDLE = FRAME.to_world(np.zeros(3))
WORLD_RADIUS = RADIUS / FRAME.scale
TITLE = '<b>matt</b> & "bright"</script>'
SCALE = Scale(0.1, "as measured")
NAMES = ('<img src=x onerror="document.title=1">', "lower & half", "=none")
CAMERAS = enumerate(cameras_around([(1.0, 0.2, 0.6), *ALL_ROUND]))
VIEWS = tuple(RunView(f"view {index}", camera, "train" if index else "eval") for index, camera in CAMERAS)
SCENE = ball_scene()
MATERIALS = replace(SCENE.materials, names=NAMES, light=torch.ones(len(SCENE.bands)))
SCENE = replace(SCENE, frame=FRAME, scale=SCALE, views=VIEWS, materials=MATERIALS)


def box(low, high):
    """In the world; FRAME keeps the vertical, in which the ball's two materials lie above each other."""
    (a, b, c), (x, y, z) = (MIDDLE + low).tolist(), (MIDDLE + high).tolist()
    return Box((a, b, c), (x, y, z))


REGIONS = {
    "cap <b>": box([-9.0, -9.0, WORLD_RADIUS / 2], [9.0] * 3),
    "below": OfMaterial(1),
    "nowhere": box([8.0] * 3, [9.0] * 3),
    "of no material": OfMaterial(7),
}


def export(
    folder, scene: Any = SCENE, regions=REGIONS, library=(), resolution=48, edits=None, illuminant=None
):
    """The facts of a page, what was said while it was made, and its file."""
    said: list[str] = []
    loaded: Any = SimpleNamespace(scene=scene, materials_scene=scene, scale=scene.scale, scene_name="ball")
    loaded.measures, loaded.record = (
        Measures(None, regions),
        SimpleNamespace(summary={"illuminant": illuminant}),
    )
    loaded.folder = SimpleNamespace(path=Path("ball/unmix-nerf/run"))
    loaded.config = SimpleNamespace(method_name="unmix-nerf")
    job = Job(loaded, folder, True, said.append, lambda _: nullcontext(), lambda _, items: iter(items), ALONE)
    asked = page.Page(resolution=resolution, library=library, edits=edits, title=TITLE)
    with few_rays(20_000):
        (path,) = page.export(job, asked)
    facts = json.loads(path.read_text().split('id="data-facts">')[1].split("</script>")[0])
    return facts, said, path
