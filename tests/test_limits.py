"""What small or long files of strangers may cost: asked before anything is decoded."""

import json
import os
import time
from typing import Any

import numpy as np
import pytest
import trimesh

from tests.factories.poses import ring, transforms
from tests.factories.systems import needs_posix
from unmix_plugin.captures.poses.reading import read_poses
from unmix_plugin.errors import SceneError, SpectrumError
from unmix_plugin.formats.libraries import library_of, read_library
from unmix_plugin.formats.meshes import read_ply_points
from unmix_plugin.limits import parse_json, parse_xml
from unmix_plugin.neumatex.tracing.mesh import read_mesh
from unmix_plugin.scenes.reading.faults import find_named


def test_a_long_text_of_empty_lists_is_refused_before_they_are_made():
    with pytest.raises(ValueError, match="its values would take up to"):
        parse_json("[" + "[]," * 8_000_000 + "1]")
    points = {str(index): {"color": [1, 2, 3], "coordinates": [0.5, 1.25, 2]} for index in range(1000)}
    assert parse_json(json.dumps(points) + " " * 20_000_000) == points


def test_a_key_with_two_values_is_refused():
    """The standard library takes the last: of two focal lengths, nobody knows which is right."""
    assert parse_json('{"a": {"fl_x": 5, "fl_x": 5}}') == {"a": {"fl_x": 5}}
    for other in ("6", "5.5", "[5]", '"5"', "null", "{}"):
        with pytest.raises(ValueError, match="'fl_x' is there twice, with different values"):
            parse_json(f'[{{"fl_x": 5, "w": 1, "fl_x": {other}}}]')


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le"])
def test_entities_are_refused_in_every_encoding(encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>'
    with pytest.raises(ValueError, match="DOCTYPE or entities"):
        parse_xml(text.encode(encoding))


def test_xml_of_millions_of_tags_is_refused():
    with pytest.raises(ValueError, match="2,200,002 tags; at most"):
        parse_xml(b"<a>" + b"<b/>" * 2_200_000 + b"</a>")


def test_a_path_through_thousands_of_folders_is_none(tmp_path):
    started = time.process_time()
    assert find_named(tmp_path, "/" + "a/" * 60_000) is None
    assert time.process_time() - started < 0.5


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
def test_gltf_of_zeros_that_are_not_in_the_file_is_refused(tmp_path, suffix):
    exported: Any = trimesh.creation.box().export(file_type="gltf")
    for name, data in exported.items():
        (tmp_path / name).write_bytes(data)
    content = json.loads(exported["model.gltf"])
    del content["accessors"][1]["bufferView"]
    content["accessors"][1]["count"] = 300_000_000
    text = json.dumps(content).encode()
    head = b"glTF" + (2).to_bytes(4, "little") + (20 + len(text)).to_bytes(4, "little")
    binary = head + len(text).to_bytes(4, "little") + b"JSON" + text
    path = tmp_path / f"model.{suffix}"
    path.write_bytes(text if suffix == "gltf" else binary)
    with pytest.raises(SceneError, match="300,000,000 numbers that are not in the file; expected at most"):
        read_mesh(path)


def test_a_mesh_that_is_placed_a_thousand_times_is_refused(tmp_path, monkeypatch):
    box, scene = trimesh.creation.box(), trimesh.Scene()
    scene.add_geometry(box, geom_name="box")
    scene.export(tmp_path / "model.glb")
    exported: Any = scene.export(file_type="gltf")
    for name, data in exported.items():
        (tmp_path / name).write_bytes(data)
    content = json.loads(exported["model.gltf"])
    mesh = next(index for index, node in enumerate(content["nodes"]) if "mesh" in node)
    first = len(content["nodes"])
    content["nodes"] += [{"mesh": content["nodes"][mesh]["mesh"]}] * 1000
    content["scenes"][0]["nodes"] += list(range(first, first + 1000))
    (tmp_path / "model.gltf").write_text(json.dumps(content))
    monkeypatch.setattr("unmix_plugin.neumatex.tracing.mesh.MAX_TRIANGLES", 12_000)
    with pytest.raises(SceneError, match="has 12,012 triangles"):
        read_mesh(tmp_path / "model.gltf")


def test_points_in_words_may_have_blank_lines_and_what_follows_them(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    (tmp_path / "a.ply").write_text(head + "end_header\n\n1 2 3\n \n4 5 6\n3 0 1 2\n")
    positions, colours = read_ply_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(positions, [[1, 2, 3], [4, 5, 6]])
    assert colours is None
    (tmp_path / "b.ply").write_text(head + "end_header")
    with pytest.raises(ValueError, match="no PLY header"):
        read_ply_points(tmp_path / "b.ply")


def test_a_message_names_a_few_of_many_columns(tmp_path):
    (tmp_path / "a.csv").write_text("wavelength" + ",a" * 10_000 + "\n450" + ",1" * 10_000 + "\n")
    with pytest.raises(SpectrumError, match="a, a and 9992 more") as refused:
        read_library(tmp_path / "a.csv")
    assert len(str(refused.value)) < 500


@needs_posix
def test_a_pipe_in_place_of_a_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "oak.hdr")
    with pytest.raises(SpectrumError, match="is no regular file"):
        library_of([tmp_path])
    content = transforms(ring())
    content = {key: value for key, value in content.items() if key not in ("w", "h")}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    for frame in content["frames"]:
        (tmp_path / frame["file_path"]).parent.mkdir(exist_ok=True)
        os.mkfifo(tmp_path / frame["file_path"])
    assert all(camera.lens is None for camera in read_poses(tmp_path).cameras.values())
