"""Readers of what a run holds, with valid samples: config, scene record, checkpoints, metrics; and of recipes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import safetensors.torch
import torch
from viser._messages import Message

from tests.factories.scenes import look_at
from tests.fuzz.mutation import Reader, mutate_json
from unmix_plugin.datamanager import HyperspectralDataManager
from unmix_plugin.editing import read_recipe, recipe_from_yaml, recipe_to_yaml
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.registry import find_method
from unmix_plugin.engine.runs.checkpoints import TrainingRecord, newest_complete_checkpoint
from unmix_plugin.engine.runs.config_json import config_to_json
from unmix_plugin.engine.runs.loading import load_config
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.run_json import RUN_FORMAT
from unmix_plugin.engine.runs.scene_record import read_scene_record
from unmix_plugin.engine.training.progress import keep_lines_until
from unmix_plugin.errors import ConfigError, RunError
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.settings import SceneOptions
from unmix_plugin.trained.measures import read_measures
from unmix_plugin.trained.regions import Box, OfMaterial, region_to_json
from unmix_plugin.trained.run_views import recorded_views, world_frame
from unmix_plugin.viewer.connections import is_heard


def _json_reader(
    file_name: str,
    contents: Iterable[dict[str, Any]],
    read: Callable[[Path], None],
    beside: tuple[tuple[str, bytes], ...] = (),
) -> Reader:
    """Of a file of a run, of which valid ones say their format."""
    samples = (json.dumps({"format_version": RUN_FORMAT, **content}).encode() for content in contents)
    return Reader(tuple(samples), file_name, read, (RunError,), mutate_json, beside)


def config_reader() -> Reader:
    configs = (config_to_json(find_method(name).config) for name in ("unmix-nerf", "neumatex"))
    contents = ({"config": config} for config in configs)
    return _json_reader("config.json", contents, _read_config, (("scene.json", b"{}"),))


def _read_config(path: Path) -> None:
    rays = load_config(path.parent).pipeline.model.eval_num_rays_per_chunk
    assert rays == "auto" or rays > 0


def _cameras(count: int = 1) -> Cameras:
    pose = torch.tensor(look_at(np.array([3.0, 1.0, 1.5]), np.zeros(3))[:3], dtype=torch.float32)
    ones = torch.ones(count, 2)
    return Cameras(pose.expand(count, 3, 4), 28 * ones, 8 * ones, torch.zeros(count, 4), 20, 16)


def scene_record_reader() -> Reader:
    cameras = _cameras(2).to_json()
    bands = {"wavelengths_nm": [450.0, 520.0, 680.0]}
    metadata = {**bands, "illuminant": [1.0, 0.9, 0.8], "has_alpha": True, "grid_resolution": 16}
    metadata |= {"pixel_size": 0.02, "subpixels": 2}
    views = {"frames": ["a", "b", "c", "d"], "train_indices": [0, 2], "eval_indices": [1, 3]}
    materials = {"material_names": ["leaf", "clay"], "endmembers": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]}
    summary = {"root": "/scenes/pots", **bands, **views, **materials, "options": asdict(SceneOptions())}
    summary["normalisation"] = Normalisation(np.eye(3), np.array([0.1, 0.2, 0.3]), 0.5).to_json()
    summary["input_hashes"] = {"transforms.json": "00"}
    content = {"scene_box": [[-1, -1, -1], [1, 1, 1.5]], "metadata": metadata, "summary": summary}
    content |= {"train_cameras": cameras, "eval_cameras": cameras}
    return _json_reader("scene.json", [content], _read_scene_record)


def _read_scene_record(path: Path) -> None:
    scene = read_scene_record(RunFolder(path.parent), HyperspectralDataManager)
    world_frame(scene)
    for view in recorded_views(scene):
        assert (path.parent / view.name).parent == path.parent


def _checkpoint() -> tuple[dict[str, Any], bytes]:
    """Record and tensors of a checkpoint."""
    tensors = safetensors.torch.save({"model/a": torch.ones(2, 3), "model/n": torch.tensor(2)})
    record = TrainingRecord(2, 0.5, 100, 0, 50, 1, 0.2, {"grid": 0.01}).to_json()
    return {**record, "step": 2, "sha256": hashlib.sha256(tensors).hexdigest()}, tensors


def checkpoint_record_reader() -> Reader:
    record, tensors = _checkpoint()
    beside = (("step-000002.safetensors", tensors),)
    return _json_reader("step-000002.json", [record], _read_checkpoint, beside)


def checkpoint_tensors_reader() -> Reader:
    return Reader((_checkpoint()[1],), "step-000002.safetensors", _read_tensors, (RunError,))


def _read_tensors(path: Path) -> None:
    """With the right hash, as only malice makes it."""
    hashed = {"format_version": RUN_FORMAT, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    record = {**_checkpoint()[0], **hashed}
    path.with_suffix(".json").write_text(json.dumps(record))
    _read_checkpoint(path)


def _read_checkpoint(path: Path) -> None:
    TrainingRecord.from_json(newest_complete_checkpoint(path.parent).record)


def measures_reader() -> Reader:
    regions = {"crown": Box((0.0, 0.1, 0.2), (0.5, 0.6, 1.0)), "leaves": OfMaterial(1)}
    content = {
        "scale": {"metres_per_unit": 0.5, "how": "a ruler"},
        "regions": {name: region_to_json(region) for name, region in regions.items()},
    }
    content["regions"]["seen"] = {"kind": "view", "camera": _cameras().to_json(), "runs": [3, 4, 313]}
    return _json_reader("measures.json", [content], _read_measures)


def _read_measures(path: Path) -> None:
    read_measures(RunFolder(path.parent))


def metrics_reader() -> Reader:
    lines = [json.dumps({"step": step, "split": "train", "loss": 0.5}) + "\n" for step in range(3)]
    return Reader(("".join(lines).encode(),), "metrics.jsonl", _read_metrics, (RunError,))


def _read_metrics(path: Path) -> None:
    before = path.read_bytes()
    keep_lines_until(
        path, 2
    )  # the part of MetricsWriter that reads; TensorBoard's would start a thread a case
    for line in path.read_text(encoding="utf-8").splitlines():
        assert json.loads(line)["step"] <= 2
    if path.read_bytes() != before:
        raise RunError("lines were dropped")


_RECIPE = b"""\
illuminant: {light: D65, extrapolate: true}
edits:
- swap: &both [0, wood]
- replace: {endmember: 2, library: ColorChecker/red}
- replace: {endmember: 3, file: paints.csv, spectrum: ochre, extrapolate: yes}
- retint: {endmember: 4, colour: '#3366cc', match: spectrum}
- scale: {endmember: 0, factor: 1.5}
- remove: *both
- isolate: [7]
- rename: {endmember: 1, name: red brick}
- gloss: {endmember: 1, scale: 0, colour: [1, .5, 0]}
"""


def recipe_reader() -> Reader:
    recipe_from_yaml("illuminant: A")  # imports colour-science: seconds that no case is to blame for
    samples = (_RECIPE, b"illuminant: lamp.csv\n", b"%YAML 1.1\n---\nedits: [remove: !!int '0x1f']\n...\n")
    return Reader(samples, "edits.yml", _read_recipe, (ConfigError,))


def _read_recipe(path: Path) -> None:
    recipe = read_recipe(path)
    written = recipe_to_yaml(recipe)
    written.encode()
    assert recipe_from_yaml(written, folder=path.parent) == recipe


def viewer_message_reader() -> Reader:
    camera = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.5, 0.0, 2.0), "fov": 0.8, "near": 0.1, "far": 10.0}
    camera |= {"image_height": 20, "image_width": 30, "look_at": (0, 0, 0), "up_direction": (0, 0, 1)}
    pointer = {"event_type": "click", "ray_origin": None, "ray_direction": (0, 0, 1)}
    messages = (
        {"type": "ViewerCameraMessage", **camera},
        {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": "r650/r550"}},
        {"type": "LocalStorageGetItemResponseMessage", "value": None, "error": None, "request_uuid": "a"},
        {"type": "ScenePointerMessage", **pointer, "screen_pos": ((0.5, 0.5),), "modifier": None},
    )
    samples = tuple(map(msgspec.msgpack.encode, messages))
    return Reader(samples, "message", lambda path: _read_message(path.read_bytes()), (ValueError,))


def _read_message(data: bytes) -> None:
    """What the viewer listens to is a message that viser reads."""
    if is_heard(data):
        Message.deserialize(data)
