"""A method brings products of its own to `unmix-export`; what is wrong with them costs nobody else anything."""

import importlib.metadata
import io

import pytest
from rich.console import Console

from tests.commands.running import run
from tests.engine.conftest import registered, short_config  # noqa: F401 (fixtures)
from unmix_plugin.commands.export import export
from unmix_plugin.engine import registry
from unmix_plugin.engine.training.trainer import Trainer


def entry(name, value):
    return importlib.metadata.EntryPoint(
        name, f"tests.commands.own_product_plugin:{value}", registry.METHOD_GROUP
    )


@pytest.fixture
def own(registered):  # noqa: F811
    registered[:] = [entry("rgb-nerf", "with_product")]
    return registered


@pytest.mark.usefixtures("own")
def test_a_product_of_a_method_is_listed_and_written_with_its_options(short_config, tmp_path):  # noqa: F811
    trainer = Trainer(short_config, console=Console(file=io.StringIO()))
    trainer.train()
    assert "view-names" in run(export, "--help").out
    words = ["view-names", "--run", trainer.run.path, "--output", tmp_path / "out", "--device", "cpu"]
    ended = run(export, *words, "--capitals")
    assert ended.status == 0, ended.err
    names = (tmp_path / "out" / "names.txt").read_text().split()
    assert len(names) == 12
    assert names[0] == "EVAL_000"
    assert "--overwrite" in run(export, *words).err
    ended = run(export, *words, "--edits", "recipe.yml")
    assert ended.status == 2


def test_a_product_is_refused_for_runs_of_other_methods(own, trained, tmp_path):
    installed = importlib.metadata.EntryPoint(
        "unmix-nerf", "unmix_plugin.method_config:unmix_nerf", registry.METHOD_GROUP
    )
    own.append(installed)
    ended = run(export, "view-names", "--run", trained.run, "--output", tmp_path, "--device", "cpu")
    assert ended.status == 2
    assert "the method unmix-nerf has no product view-names: it needs a run of rgb-nerf" in " ".join(
        ended.err.split()
    )


def test_products_that_fail_or_whose_name_is_taken_are_skipped_and_said(own):
    own += [entry("rgb-2", "clashing"), entry("rgb-3", "broken")]
    ended = run(export, "--help")
    assert ended.status == 0
    assert "skipped the plugin rgb-2: another product has the name mesh already" in ended.err
    assert "skipped the plugin rgb-3: its products: ImportError: no module named scissors" in ended.err
    assert "view-names" in ended.out
    assert run(export, "mesh", "--help").out.count("--smoothing") > 0
