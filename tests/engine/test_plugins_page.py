"""docs/guides/plugins.md: it lists the public names, and its example trains, is evaluated and rendered."""

import importlib.metadata
import json
import re
import sys
import types
from pathlib import Path
from typing import Any, get_args

import pytest

import unmix_plugin.engine
from tests.factories.commands import done, run
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.engine import Output, outputs, registry
from unmix_plugin.engine.runs.load_run import load_model
from unmix_plugin.scenes.demo.scene import make_demo_scene

PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "plugins.md").read_text(encoding="utf-8")


def test_the_public_names_are_those_that_the_page_lists():
    section = PAGE.split("## The public names")[1].split("\n## ")[0]
    table = "".join(line for line in section.splitlines() if line.startswith("|"))
    public = sorted(unmix_plugin.engine.__all__)
    assert sorted(re.findall(r"`(\w+)`", table)) == public
    assert sorted(name for names in unmix_plugin.engine._MODULES.values() for name in names) == public
    for name in {*public} - {"AtStartOnly", "CommonFlag", "Target", "UNDECIDED"}:
        assert getattr(unmix_plugin.engine, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'GradientGuard'"):
        _ = unmix_plugin.engine.GradientGuard


def test_the_example_of_the_page_imports_public_names_only_trains_and_is_evaluated(tmp_path, monkeypatch):
    (code,) = re.findall(r"^`spectral_grid.py`\n\n```python\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
    ours = set(re.findall(r"from (unmix_plugin\S*) import", code))
    assert ours == {"unmix_plugin.datamanager", "unmix_plugin.engine"}
    module = types.ModuleType("spectral_grid")
    monkeypatch.setitem(sys.modules, "spectral_grid", module)
    exec(compile(code, "spectral_grid.py", "exec"), module.__dict__)
    entry = importlib.metadata.EntryPoint("spectral-grid", "spectral_grid:method", registry.METHOD_GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [entry])  # noqa: ARG005
    make_demo_scene(tmp_path / "scene", 16, 4, 8)
    argv = ["--data", tmp_path / "scene", "--output-dir", tmp_path / "out", "--pipeline.model.resolution", 8]
    ended = done(train, "spectral-grid", *argv, "--max-num-iterations", 3, "--device", "cpu")
    path = Path(ended.last_line.removeprefix("run: "))
    loaded = load_model(path, "cpu")
    view = loaded.model.get_outputs_for_camera(loaded.scene.eval_cameras[0])
    assert view["spectral"].shape == (16, 16, 4)

    for named in ((), (Output("spectral", "channels", "spectra", "radiance on black"),)):
        monkeypatch.setattr(module.SpectralGrid, "outputs", named, raising=False)
        done(evaluate, "--run", path, "--device", "cpu")
        metrics = json.loads((path / "eval" / "metrics.json").read_text())
        assert metrics["psnr"] > 3
        assert metrics["views"] == 2
        assert [image["name"] for image in metrics["per_image"]] == ["eval_002", "eval_006"]
    ended = run(evaluate, "--run", path, "--illuminant", "A", "--device", "cpu")
    assert "the method spectral-grid makes no scene of mixed materials" in " ".join(ended.err.split())
    done(render, "--run", path, "--output", tmp_path / "views", "--device", "cpu")
    assert len(list((tmp_path / "views" / "spectral").glob("*.hdr"))) == 2


def test_the_outputs_and_the_product_of_the_page_are_ones():
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
    [shown] = [block for block in blocks if block.startswith("outputs = (")]
    names: dict[str, Any] = {"Output": Output}
    exec(compile(shown, "plugins.md", "exec"), names)
    spectral, depth, roughness = names["outputs"]
    assert spectral.what == "radiance on black, 1 = full scale"
    assert depth.what == "distance along the viewing axis in world units"
    assert (roughness.value_range, roughness.colour_map) == ((0.0, 1.0), "magma")
    kinds = set(re.findall(r"`(\w+)`", "".join(re.findall(r"^  \| (.*?) \|", PAGE, re.MULTILINE))))
    kinds |= set(re.findall(r"; `(\w+)`: of what is seen", PAGE))
    assert kinds == set(get_args(outputs.OutputKind))
    [product] = [block for block in blocks if "class Grid(RunProduct)" in block]
    names = {}
    exec(compile(product, "plugins.md", "exec"), names)
    assert names["Grid"]().name == "grid"
