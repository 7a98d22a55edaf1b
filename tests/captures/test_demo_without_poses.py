"""The demo capture without poses, from raw counts to a scene whose cameras are where the true ones are."""

from functools import partial
from pathlib import Path

import pytest

from tests.captures.poses.alignment import align_poses
from tests.commands.running import run
from unmix_plugin.captures import demo as demo_capture
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.commands.process import process
from unmix_plugin.scenes.demo.shading import render_view
from unmix_plugin.scenes.reading.loader import load_scene

SIZE, BANDS, VIEWS = 192, 12, 24


@pytest.mark.slow
@pytest.mark.usefixtures("no_wait_for_the_disk")
def test_estimated_poses_are_those_of_the_truth(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(demo_capture, "render_view", partial(render_view, subpixels=2))
    capture, scene = tmp_path / "capture", tmp_path / "scene"
    demo_capture.make_demo_capture(capture, SIZE, BANDS, VIEWS)
    words = ["cubes", "--data", capture, "--output-dir", scene, "--poses", "estimate", "--mask", "black"]
    words += ["--white", capture / "white.hdr", "--dark", capture / "dark.hdr"]

    ended = run(process, *words)

    assert ended.status == 0, ended.err
    assert ended.last_line == f"scene: {scene}"
    found, truth = read_poses(scene / "transforms.json"), read_poses(capture / "poses-true.json")
    names = {name: f"{Path(name).stem}.hdr" for name in found.cameras}
    assert len(names) >= 0.8 * VIEWS
    assert align_poses(found, truth, names).rms_px < 0.5
    loaded = load_scene(scene)
    assert len(loaded.frames) == len(names)
    assert loaded.placement.is_identity, "exports come out in the upright world of transforms.json"
    report = (scene / "report.txt").read_text()
    assert "- bands left out: 400 nm, 509.091 nm (marked as bad in the file)\n" in report
    assert "- bands left out: 618.182 nm (noisy)\n" in report
    assert "- saturation: from 65535 (" in report
