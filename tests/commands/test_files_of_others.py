"""Nothing that somebody else put into a folder is replaced, changed or removed by any command, asked to overwrite or
not: it stays, or the command refuses and names it."""

import hashlib
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.factories.captures import make_capture
from tests.factories.commands import done, run
from tests.factories.mixtures import smooth_endmembers
from tests.factories.runs import PRODUCT_NAMES, export_words
from tests.factories.systems import needs_posix
from tests.spectral.unmixing.test_image import image_of
from unmix_plugin import open_run, save
from unmix_plugin.commands.demo_scene import write_demo_scene
from unmix_plugin.commands.eval import evaluate
from unmix_plugin.commands.export import export
from unmix_plugin.commands.image import image
from unmix_plugin.commands.process import process
from unmix_plugin.commands.render import render
from unmix_plugin.engine.runs.atomic_files import whole_file, write_file
from unmix_plugin.engine.runs.replacing import LIST_NAME
from unmix_plugin.errors import RunError
from unmix_plugin.formats.envi import write_envi_cube
from unmix_plugin.spectral.bands import Bands

pytestmark = needs_posix


def snapshot(folder):
    """What lies where: bytes of files by their hash, links by where they lead."""
    found = {}
    for parent, folders, files in os.walk(folder):
        for path in (Path(parent, name) for name in (*folders, *files)):
            if path.is_symlink():
                found[path] = os.readlink(path)  # noqa: PTH115 - text, as it was written
            elif path.is_file():
                found[path] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def as_files(at):
    at.parent.mkdir(parents=True, exist_ok=True)
    at.write_text(f"somebody's {at.name}")


def as_links(at):
    at.parent.mkdir(parents=True, exist_ok=True)
    at.symlink_to(kept := at.parent / f"kept by others {at.name}")
    kept.write_text("somebody's")


def as_folders(at):
    at.mkdir(parents=True)
    (at / "notes.txt").write_text("somebody's")


WAYS = {"files": as_files, "links": as_links, "folders": as_folders}


def require_kept(names, output, way, *command):
    """Put others' files where a command writes, run it, and see them all there afterwards."""
    shutil.rmtree(output, ignore_errors=True)
    for name in names:
        WAYS[way](output / name)
    before = snapshot(output)
    assert before
    ended = run(*command)
    assert ended.status in (0, 2), ended.err
    after = snapshot(output)
    assert {path: after.get(path) for path in before} == before, ended.out
    if ended.status == 2:
        assert "is in the way" in ended.err or "are in the way" in ended.err or "can't" in ended.err, (
            ended.err
        )


def written(output):
    return [
        path.relative_to(output) for path in output.rglob("*") if path.is_file() and path.name != LIST_NAME
    ]


@pytest.mark.parametrize("way", WAYS)
def test_of_an_image(tmp_path, way):
    cube = image_of(smooth_endmembers(2), size=8).astype(np.float32)
    write_envi_cube(tmp_path / "field", cube, Bands.of(np.linspace(450, 900, cube.shape[2])), None, "a field")
    words = (
        image,
        tmp_path / "field.hdr",
        "--endmembers",
        2,
        "--output-dir",
        tmp_path / "out",
        "--overwrite",
    )
    done(*words)
    require_kept(written(tmp_path / "out"), tmp_path / "out", way, *words)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("kind", [[], ["--raw"]], ids=["scene", "raw"])
def test_of_demo_scenes(tmp_path, kind, way):
    bands = 10 if kind else 3
    words = (
        write_demo_scene,
        tmp_path / "out",
        "--size",
        16,
        "--bands",
        bands,
        "--views",
        4,
        "--overwrite",
        *kind,
    )
    done(*words)
    names = written(tmp_path / "out")
    require_kept(names, tmp_path / "out", way, *words)
    others = [name for name in names if name.parent.name]  # the main file is refused first
    require_kept(others, tmp_path / "out", way, *words)
    require_kept(["train_000.png", "images/mine.png", "cubes/train_999.npy"], tmp_path / "out", way, *words)
    require_kept(["cubes", "truth"], tmp_path / "out", way, *words)


@pytest.mark.parametrize("way", WAYS)
def test_of_a_run(trained, exported, run_copy, tmp_path, way):
    names = {name: written(exported[0] / name) for name in PRODUCT_NAMES}
    for name in PRODUCT_NAMES if way == "files" else ("endmembers", "poses"):
        words = export_words(name, "--run", trained.run, "--output", tmp_path / "out", "--overwrite")
        require_kept(names[name], tmp_path / "out", way, export, *words)
    words = ("--run", run_copy, "--outputs", "rgb", "segmentation", "--device", "cpu", "--overwrite")
    done(render, *words, "--output", tmp_path / "rendered")
    names = written(tmp_path / "rendered")
    require_kept(names, tmp_path / "rendered", way, render, *words, "--output", tmp_path / "rendered")
    done(evaluate, "--run", run_copy, "--device", "cpu")
    done(evaluate, "--run", run_copy, "--device", "cpu")  # its own earlier files are replaced
    names = written(run_copy / "eval")
    if way != "links":  # out of the run, which is refused
        require_kept(names, run_copy / "eval", way, evaluate, "--run", run_copy, "--device", "cpu")
        shutil.rmtree(run_copy / "eval")
        first = Path(shutil.copytree(trained.run, tmp_path / "first" / trained.run.name))
        pair = (evaluate, first, run_copy, "--device", "cpu")
        done(*pair)
        comparison = first / "exports" / "comparison"
        require_kept([*written(comparison), "rgb/mine.png"], comparison, way, *pair)


def test_of_a_saved_view(trained, tmp_path):
    scene = open_run(trained.run, device="cpu")
    view = scene.look(scene.views[0].camera)
    for suffix in (".png", ".npy", ".exr", ".hdr"):
        path = save(view, "depth", tmp_path / f"view{suffix}")
        save(view, "depth", path)  # ours
        path.write_bytes(b"somebody's")
        with pytest.raises(RunError, match="is in the way"):
            save(view, "depth", path)
        assert path.read_bytes() == b"somebody's"


POSED = ["--poses", "transforms.json", "--mask", "none"]


@pytest.fixture
def capture(tmp_path):
    return make_capture(tmp_path / "capture")


def test_of_a_raw_capture_that_is_called_like_what_a_scene_is_moved_to(capture, tmp_path):
    for name in ("y.old", "y.unfinished"):
        data = Path(shutil.copytree(capture.root, tmp_path / name))
        before = snapshot(data)
        for more in ([], ["--overwrite"]):
            words = ["cubes", "--data", data, "--output-dir", tmp_path / "y", *POSED, *more]
            ended = run(process, *words)
            assert ended.status == (0 if name == "y.old" else 2), ended.err
            assert snapshot(data) == before
        shutil.rmtree(data)
        shutil.rmtree(tmp_path / "y", ignore_errors=True)


def test_of_a_scene_that_is_made_again(capture, tmp_path):
    output = tmp_path / "scene"
    words = ["cubes", "--data", capture.root, "--output-dir", output, *POSED]
    done(process, *words)
    done(process, *words, "--overwrite")  # all of it is its own
    whole = snapshot(output)
    for name in ("notes.txt", "cubes/notes.npy", "transforms.json", "mine/deep/file"):
        (output / name).parent.mkdir(parents=True, exist_ok=True)
        kept = (output / name).read_bytes() if (output / name).exists() else None
        (output / name).write_text("somebody's")
        before = snapshot(output)
        ended = run(process, *words, "--overwrite")
        assert (ended.status, snapshot(output)) == (2, before)
        assert str(output / name) in ended.err
        (output / name).unlink() if kept is None else (output / name).write_bytes(kept)
    assert snapshot(output) == whole
    # What the call reads lies in what it would replace.
    poses = shutil.copy(capture.root / "transforms.json", output / "poses.json")
    link = tmp_path / "link"
    link.symlink_to(output)
    for given in (poses, link / "poses.json"):
        ended = run(process, *words, "--poses", given, "--overwrite")
        assert (ended.status, Path(poses).exists()) == (2, True)
    Path(poses).unlink()
    # A folder of the name that is moved to.
    unfinished = tmp_path / "scene.unfinished"
    unfinished.mkdir()
    (unfinished / "plan.json").write_text("{}")
    (unfinished / "mine.txt").write_text("somebody's")
    before = snapshot(unfinished)
    ended = run(process, *words, "--overwrite", "--bin-bands", 2)
    assert (ended.status, snapshot(unfinished)) == (2, before)
    assert "was not made by unmix-process" in ended.err


def test_two_writers_of_one_name_have_each_their_own_temporary_file(tmp_path):
    with whole_file(tmp_path / "a.txt") as first, whole_file(tmp_path / "a.txt") as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "a.txt").read_text() == "first"  # the block that ended last


def test_a_temporary_file_of_others_is_never_removed(tmp_path):
    from unmix_plugin.engine.runs.replacing import remove_stale_temporaries, temporary_name

    stale = temporary_name(tmp_path / "a.npy")
    for name in (".a.npy.123.tmp", ".mine.tmp", "b.tmp"):
        (tmp_path / name).write_text("somebody's")
    stale.write_text("ours")
    remove_stale_temporaries(tmp_path)
    assert not stale.exists()
    assert len(list(tmp_path.iterdir())) == 3


def test_the_list_of_files_is_what_sha256sum_reads(tmp_path):
    write_file(tmp_path / "a b.txt", b"one")
    write_file(tmp_path / "a b.txt", b"two")
    lines = (tmp_path / LIST_NAME).read_text().splitlines()
    assert lines[0].startswith("#")
    assert lines[1:] == [f"{hashlib.sha256(data).hexdigest()}  a b.txt" for data in (b"one", b"two")]
