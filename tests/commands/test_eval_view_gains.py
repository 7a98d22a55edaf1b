"""Evaluation of a run whose training views had gains of their own: each view is aligned first, and it is said."""

import json
from pathlib import Path

import numpy as np

from tests.commands.running import SMALL_METHOD, run
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.train import train
from unmix_plugin.scenes.demo.scene import make_demo_scene


def evaluated_psnr(scene: Path, output: Path) -> tuple[float, str]:
    words = ["--data", scene, "--output-dir", output, "--max-num-iterations", 20, "--light", "per-view"]
    ended = run(train, "unmix-nerf", *words, *SMALL_METHOD)
    assert ended.status == 0, ended.err
    path = Path(ended.last_line.removeprefix("run: "))
    found = run(evaluate, "--run", path, "--device", "cpu")
    assert found.status == 0, found.err
    return json.loads((path / "eval" / "metrics.json").read_text())["psnr_matter"], found.out


def test_the_gain_of_an_evaluation_view_does_not_count(tmp_path):
    scene = tmp_path / "scene"
    make_demo_scene(scene, 16, 8, 8)
    plain, said = evaluated_psnr(scene, tmp_path / "plain")
    assert "each evaluation view was aligned first" in said
    content = json.loads((scene / "transforms.json").read_text())
    names = content.get("val_filenames") or content["test_filenames"]
    for frame in content["frames"]:
        if frame["file_path"] in names:
            cube = scene / frame["hyperspectral_file_path"]
            np.save(cube, (0.5 * np.load(cube).astype(np.float32)).astype(np.float16))
    halved, _ = evaluated_psnr(scene, tmp_path / "halved")
    # Half the light has half the error after alignment: 6 dB.
    assert abs(halved - plain - 6.02) < 0.5
