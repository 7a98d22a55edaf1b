"""`unmix-export`: what is written and refused, and products that methods bring along."""

import errno
import importlib.metadata
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from tests.commands.running import picture_size, run
from tests.engine.conftest import registered, short_config  # noqa: F401 (fixtures)
from tests.engine.stopped_runs import finished
from unmix_plugin.commands.export import export
from unmix_plugin.engine import registry
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv
from unmix_plugin.trained.open_run import load_run


@pytest.fixture(scope="module")
def model_outputs(trained):
    """What the trained model renders of its evaluation views, by view name."""
    loaded = load_run(trained.run, "cpu")
    names = ["eval_002", "eval_006"]
    outputs = ["abundances", "accumulation", "segmentation"]
    return {
        name: {
            key: value.numpy()
            for key, value in loaded.scene.render(loaded.record.eval_cameras[index], outputs).items()
        }
        for index, name in enumerate(names)
    }


def test_abundances_are_the_models_and_sum_to_its_opacity(trained, tmp_path, model_outputs):
    ended = run(export, "abundances", "--run", trained.run, "--output", tmp_path, "--device", "cpu")
    assert ended.status == 0, ended.err
    for name, outputs in model_outputs.items():
        exported = np.load(tmp_path / f"{name}.npy")
        assert (exported.dtype, exported.shape) == (np.float32, (16, 16, 6))
        np.testing.assert_array_equal(exported, outputs["abundances"])
        np.testing.assert_allclose(exported.sum(axis=-1), outputs["accumulation"], atol=1e-5)
        assert min(picture_size(tmp_path / f"{name}.png")) > 200
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"{name}.{kind}" for name in model_outputs for kind in ("npy", "png")
    ]
    for path in tmp_path.iterdir():
        assert str(path) in ended.out


def test_segmentation_is_the_models_ids_their_scores_and_a_figure(trained, tmp_path, model_outputs):
    ended = run(export, "segmentation", "--run", trained.run, "--output", tmp_path, "--device", "cpu")
    assert ended.status == 0, ended.err
    for name, outputs in model_outputs.items():
        ids = np.asarray(Image.open(tmp_path / "labels" / f"{name}.png"))
        scores = np.load(tmp_path / f"{name}.npy")
        assert (ids.dtype, scores.dtype, scores.shape) == (np.uint8, np.float32, (16, 16, 6))
        np.testing.assert_array_equal(ids, outputs["segmentation"])
        seen = ids != 255
        np.testing.assert_array_equal(ids[seen], scores.argmax(axis=-1)[seen])
        np.testing.assert_array_equal(seen, outputs["accumulation"] >= 0.5)
        assert (tmp_path / f"{name}.png").is_file()


def test_endmembers_are_those_of_the_run_as_csv_and_plot(trained, tmp_path):
    ended = run(export, "endmembers", "--run", trained.run, "--output", tmp_path, "--device", "cpu")
    assert ended.status == 0, ended.err
    assert (tmp_path / "endmembers.csv").read_bytes() == (trained.run / "endmembers.csv").read_bytes()
    assert read_spectra_csv(tmp_path / "endmembers.csv").spectra.shape == (6, 8)
    assert min(picture_size(tmp_path / "endmembers.png")) > 400


@pytest.mark.parametrize(("views", "count"), [("eval", 2), ("train", 6), ("all", 8)])
def test_views_are_chosen_by_split_and_named_as_the_frames(trained, tmp_path, views, count):
    ended = run(export, "abundances", "--run", trained.run, "--output", tmp_path, "--views", views)
    assert ended.status == 0, ended.err
    names = {path.stem for path in tmp_path.glob("*.npy")}
    frames = {path.stem for path in (trained.scene / "cubes").iterdir()}
    assert len(names) == count
    assert names == {name for name in frames if views == "all" or name.startswith(views)}


def test_without_run_the_newest_is_exported(run_copy, monkeypatch, tmp_path):
    shutil.move(run_copy.parents[2], tmp_path / "outputs")
    monkeypatch.chdir(tmp_path)
    ended = run(export, "endmembers")
    assert ended.status == 0, ended.err
    assert (
        tmp_path / "outputs/demo/unmix-nerf" / run_copy.name / "exports/endmembers/endmembers.csv"
    ).is_file()


@pytest.mark.parametrize("product", ["abundances", "segmentation"])
def test_a_full_disk_exits_2_says_where_and_leaves_no_part_of_a_file(trained, tmp_path, monkeypatch, product):
    def full(*_args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "write", full)
    ended = run(export, product, "--run", trained.run, "--output", tmp_path)
    assert ended.status == 2
    assert f"can't write {tmp_path / 'eval_002.npy'}: No space left on device" in ended.err
    assert "--load-run" not in ended.err
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_folder_that_cannot_be_made_exits_2(trained, tmp_path):
    (tmp_path / "file").write_text("in the way")
    ended = run(export, "endmembers", "--run", trained.run, "--output", tmp_path / "file" / "here")
    assert ended.status == 2
    assert str(tmp_path / "file" / "here") in ended.err


@pytest.mark.parametrize("words", [[], ["spectra"], ["abundances", "--views", "some"]])
def test_words_that_do_not_parse_exit_2(words):
    ended = run(export, *words)
    assert ended.status == 2
    assert ended.err


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
    trainer = finished(short_config)
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


def test_help_imports_neither_torch_nor_what_writes_products():
    code = (
        "import sys\nfrom unmix_plugin.commands.entry import run_command\n"
        "from unmix_plugin.commands.export import export\n"
        "for words in ['--help'], ['mesh', '--help']:\n"
        "    try:\n        run_command(export, words)\n"
        "    except SystemExit as stop:\n"
        "        heavy = {'torch', 'warp', 'scipy', 'skimage', 'matplotlib', 'PIL'}\n"
        "        print('end:', stop.code, sorted(heavy & set(sys.modules)))\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.count("end: 0 []\n") == 2, ended.stdout
