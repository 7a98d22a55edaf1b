"""docs/guides/plugins.md: it lists the public names, and its example trains, is evaluated and rendered."""

import importlib.metadata
import json
import re
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest

import unmix_plugin.engine
from tests.factories.commands import done, refused, run
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.render import render
from unmix_plugin.commands.train import train
from unmix_plugin.engine import Output, outputs, registry
from unmix_plugin.engine.runs.loading import load_model
from unmix_plugin.formats.envi import read_header
from unmix_plugin.scenes.demo.scene import make_demo_scene

PAGE = (Path(__file__).parents[2] / "docs" / "guides" / "plugins.md").read_text(encoding="utf-8")


def test_the_public_names_are_those_that_the_page_lists():
    section = PAGE.split("## The public names")[1].split("\n## ")[0]
    table = "".join(line for line in section.splitlines() if line.startswith("|"))
    public = sorted(unmix_plugin.engine.__all__)
    assert sorted(re.findall(r"`(\w+)`", table)) == public
    for name in {*public} - {"AtStartOnly", "CommonFlag", "Target", "UNDECIDED"}:
        assert getattr(unmix_plugin.engine, name).__name__ == name
    with pytest.raises(AttributeError, match="has no attribute 'GradientGuard'"):
        _ = unmix_plugin.engine.GradientGuard


def test_the_example_of_the_page_imports_public_names_only_trains_and_is_evaluated(tmp_path, monkeypatch):
    (code,) = re.findall(r"^`spectral_grid.py`\n\n```python\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE)
    ours = set(re.findall(r"from (unmix_plugin\S*) import", code))
    assert ours == {"unmix_plugin.datamanager", "unmix_plugin.engine", "unmix_plugin.spectral.metrics"}
    module = types.ModuleType("spectral_grid")
    monkeypatch.setitem(sys.modules, "spectral_grid", module)
    exec(compile(code, "spectral_grid.py", "exec"), module.__dict__)
    entry = importlib.metadata.EntryPoint("spectral-grid", "spectral_grid:method", registry.METHOD_GROUP)
    known = [*registry.entry_points(group=registry.METHOD_GROUP), entry]
    monkeypatch.setattr(registry, "entry_points", lambda group: known)  # noqa: ARG005
    make_demo_scene(tmp_path / "scene", 16, 4, 8)
    argv = ["--data", tmp_path / "scene", "--output-dir", tmp_path / "out", "--pipeline.model.resolution", 8]
    ended = done(train, "spectral-grid", *argv, "--max-num-iterations", 3, "--device", "cpu")
    path = Path(ended.last_line.removeprefix("run: "))
    loaded = load_model(path, "cpu")
    view = loaded.model.get_outputs_for_camera(loaded.record.eval_cameras[0])
    assert view["spectral"].shape == (16, 16, 4)

    argv = ["--data", tmp_path / "scene", "--output-dir", tmp_path / "out", "--endmembers", 4]
    ended = done(train, "unmix-nerf", *argv, "--max-num-iterations", 3, "--device", "cpu")
    ours_path = Path(ended.last_line.removeprefix("run: "))
    done(evaluate, path, ours_path, "--device", "cpu")
    metrics = json.loads((path / "eval" / "metrics.json").read_text())
    assert [image["name"] for image in metrics["per_view"]] == ["eval_002", "eval_006"]
    for own, figure in (("image_psnr", "psnr"), ("image_sam", "sam")):
        views = zip(metrics["own_per_image"], metrics["per_view"], strict=True)
        assert figure == "sam" or all(
            one[own] == pytest.approx(other[figure], abs=1e-4) for one, other in views
        )
    table = (path / "exports" / "comparison" / "figures.csv").read_text().splitlines()
    rows = {row.split(",")[0]: row.split(",")[1:3] for row in table}
    assert {"psnr", "ssim", "sam"} <= {name for name, values in rows.items() if all(values)}
    assert rows["miou"][0] == "" != rows["miou"][1]

    done(
        render, "--run", path, "--output", tmp_path / "banded", "--device", "cpu", "--formats", "envi", "exr"
    )
    folder, nm = tmp_path / "banded" / "spectral", loaded.model.metadata["wavelengths_nm"]
    header = read_header(next(folder.glob("*.hdr")))
    assert [float(one) for one in header["wavelength"].split(",")] == pytest.approx(nm)
    assert next(folder.glob("*.exr")).read_bytes().count(b"S0.") >= len(nm)

    spectral, *_ = module.SpectralGrid.outputs
    monkeypatch.setattr(module.SpectralGrid, "outputs", (replace(spectral, centers_nm=(1.0, 2.0, 3.0, 4.0)),))
    assert "spectra are measured on the scene's own bands" in refused(
        evaluate, "--run", path, "--device", "cpu"
    )
    for named in ((), (Output("spectral", "channels", "spectra", "radiance on black"),)):
        monkeypatch.setattr(module.SpectralGrid, "outputs", named)
        done(evaluate, "--run", path, "--device", "cpu")
        metrics = json.loads((path / "eval" / "metrics.json").read_text())
        assert metrics["image_psnr"] > 3
        assert metrics["views"] == 2
        assert [image["name"] for image in metrics["per_image"]] == ["eval_002", "eval_006"]
        said = refused(evaluate, path, ours_path, "--device", "cpu")
        assert "an Output of kind channels with a quantity" in said
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
