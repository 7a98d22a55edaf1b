"""Every reader of files that strangers make: valid samples, how to read damaged ones, and what it may raise.

A reader gets the damaged bytes as a file, and either reads them or raises one of the errors that it promises. To add
one, write a function that makes a `Reader` and name it in `READERS`.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from PIL import Image

from tests.fuzz import pose_samples
from tests.fuzz.capture_samples import ENVI_DATA, SAMPLES, read_capture
from tests.fuzz.mutation import Mutator, mutate_bytes, mutate_json, mutate_png
from tests.scenes.scene_factory import look_at
from unmix_plugin.datamanager import HyperspectralDataManager
from unmix_plugin.editing import read_recipe, recipe_from_yaml, recipe_to_yaml
from unmix_plugin.engine.geometry.cameras import Cameras
from unmix_plugin.engine.registry import find_method
from unmix_plugin.engine.runs.checkpoints import newest_complete_checkpoint
from unmix_plugin.engine.runs.config_json import config_to_json
from unmix_plugin.engine.runs.load_run import load_config
from unmix_plugin.engine.runs.run_files import RUN_FORMAT
from unmix_plugin.engine.runs.run_folder import RunFolder
from unmix_plugin.engine.runs.scene_record import read_scene_record
from unmix_plugin.engine.training.training_state import TrainingRecord
from unmix_plugin.engine.training.writers import _keep_until
from unmix_plugin.errors import CaptureError, ConfigError, RunError, SceneError, SpectrumError
from unmix_plugin.scenes.reading.arrays import UnreadableArrayError, read_array_header
from unmix_plugin.scenes.reading.cube_values import measure_cube
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.frame_files import locate_files
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_colour, read_labels, read_mask
from unmix_plugin.scenes.reading.splits import split_frames
from unmix_plugin.scenes.reading.transforms_json import read_transforms
from unmix_plugin.scenes.scene import Normalisation, SceneOptions
from unmix_plugin.spectral.library.spectra_csv import read_spectra_csv
from unmix_plugin.spectral.library.spectra_envi import read_spectra_envi
from unmix_plugin.spectral.maps.index_formula import parse_formula
from unmix_plugin.trained.camera_files.camera_files import read_camera_file
from unmix_plugin.trained.run_views import recorded_views
from unmix_plugin.trained.world_frame import world_frame


@dataclass(frozen=True)
class Reader:
    """One reader under test."""

    samples: tuple[bytes, ...]
    """Valid inputs, of many kinds."""
    file_name: str
    """What the file is called that `read` gets."""
    read: Callable[[Path], object]
    """Reads a file; nothing else lies beside it but what `companions` names."""
    allowed: tuple[type[Exception], ...]
    """What it may raise."""
    mutate: Mutator = mutate_bytes
    companions: tuple[tuple[str, bytes], ...] = ()
    """Names and contents of files beside it."""


def _transforms() -> Reader:
    pose = look_at(np.array([3.0, 1.0, 1.5]), np.zeros(3)).tolist()
    frames = [
        {
            "hyperspectral_file_path": f"cubes/{split}_{i}.npy",
            "file_path": f"{split}_{i}.png",
            "transform_matrix": pose,
        }
        for i, split in enumerate(("train", "eval", "train"))
    ]
    frames[0].update(
        mask_path="mask.png", seg_file_path="s.png", abundance_file_path="a.npy", k1=0.1, fl_x=20
    )
    whole = {
        "camera_model": "OPENCV",
        "w": 20,
        "h": 16,
        "fl_x": 28.0,
        "fl_y": 28.5,
        "cx": 10.0,
        "cy": 8.0,
        "p1": 0.0,
        "wavelengths": [450.0, 520.0, 600.5, 680],
        "materials": ["leaf", "clay"],
        "illuminant_path": "illuminant.csv",
        "endmembers_path": "endmembers.csv",
        "train_filenames": ["train_0.png", "train_2.png"],
        "test_filenames": ["eval_1.png"],
        "frames": frames,
    }
    bare = {
        "camera_angle_x": 0.7,
        "distortion_params": [0.1, 0, 0, 0, 0, 0.2],
        "wavelengths": [400, 500],
        "frames": frames[1:],
    }
    samples = tuple(json.dumps(content).encode() for content in (whole, bare))
    named = {path for frame in frames for key, path in frame.items() if key.endswith("_path")}
    beside = tuple((str(path), b"") for path in sorted(named))
    return Reader(samples, "transforms.json", _read_transforms, (SceneError,), mutate_json, beside)


def _read_transforms(path: Path) -> None:
    faults = Faults(path.parent)
    entry = read_transforms(path.parent, faults)
    locate_files(path.parent, entry, SceneOptions(), faults)
    for method in ("auto", "filename", "interval"):
        split_frames(entry, method, 2, faults)
    for frame in entry.frames:
        if frame.intrinsics is not None:
            focal = np.array(frame.intrinsics.focal_at(20), dtype=np.float32)
            assert np.isfinite(focal).all()
            assert focal.min() > 0
    faults.raise_if_any()


def _cube() -> Reader:
    values = np.random.default_rng(0).uniform(0, 1, (6, 5, 4))
    arrays = [values.astype(kind) for kind in ("<f2", ">f4", "<f8")]
    arrays += [(values * 4095).astype(kind) for kind in ("<u2", ">i4")]
    arrays += [np.asfortranarray(values, np.float32), np.where(values < 0.1, -values, values).astype("f4")]
    return Reader(tuple(_npy(array) for array in arrays), "cube.npy", _read_cube, (UnreadableArrayError,))


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _read_cube(path: Path) -> None:
    header = read_array_header(path)
    if len(header.shape) == 3 and 0 not in header.shape:
        values = measure_cube(path, None, "refuse")
        assert 0 <= values.num_invalid_pixels <= values.num_pixels


_SIZE = (16, 20)


def _picture() -> Reader:
    rgba = np.random.default_rng(0).integers(0, 256, (*_SIZE, 4), dtype=np.uint8)
    samples = []
    for mode in ("RGBA", "RGB", "L", "P", "LA", "1", "I;16"):
        image = Image.fromarray(rgba[..., 0].astype(np.uint16)) if mode == "I;16" else Image.fromarray(rgba)
        samples.append(_encoded(image if mode == "I;16" else image.convert(mode), "PNG"))
    colour = Image.fromarray(rgba[..., :3])
    samples += [_encoded(colour, "JPEG"), _encoded(colour, "TIFF")]
    samples += [_encoded(colour, name) for name in ("BMP", "GIF", "PPM", "EPS")]
    return Reader(tuple(samples), "picture.png", _read_picture, (UnreadableImageError,), mutate_png)


def _encoded(image: Image.Image, form: str) -> bytes:
    file = io.BytesIO()
    image.save(file, form)
    return file.getvalue()


def _read_picture(path: Path) -> None:
    for read in (read_mask, read_colour):
        assert read(path, _SIZE).shape[:2] == _SIZE


def _labels() -> Reader:
    colour = _picture()
    return replace(colour, file_name="labels.png", read=lambda path: read_labels(path, _SIZE))


_ENVI = """ENVI
description = {
  Two spectra, with a comment}
samples = 3
lines = 2
bands = 1
header offset = 0
file type = ENVI Spectral Library
data type = 4
byte order = 0
reflectance scale factor = 10000
; a comment
wavelength units = Micrometers
data ignore value = -9999
spectra names = {oak, fir
 tree}
wavelength = {0.45, 0.55, 0.65}
"""


def _envi_header() -> Reader:
    other = _ENVI.replace("data type = 4", "data type = 12").replace("Micrometers", "nm").replace("0.", "1")
    plain = "\n".join(line for line in other.splitlines() if "factor" not in line and "ignore" not in line)
    samples = tuple(text.encode() for text in (_ENVI, other, plain, _ENVI.replace("\n", "\r\n")))
    beside = (("library.sli", np.linspace(0, 9000, 6).astype("<f4").tobytes()),)
    return Reader(samples, "library.hdr", read_spectra_envi, (SpectrumError,), companions=beside)


def _envi_values() -> Reader:
    samples = (np.linspace(0, 9000, 6).astype("<f4").tobytes(),)
    return Reader(
        samples,
        "library.sli",
        read_spectra_envi,
        (SpectrumError,),
        companions=(("library.hdr", _ENVI.encode()),),
    )


def _spectra_csv() -> Reader:
    samples = (
        b"wavelength,leaf,clay\n450,0.1,0.2\n520,0.3,0.5\n600,0.1,0.8\n",
        b'\xef\xbb\xbfwavelength_nm,"power, relative"\r\n\r\n400.5,1\r\n500,2e-3\r\n',
    )
    return Reader(samples, "spectra.csv", read_spectra_csv, (SpectrumError,))


def _cameras() -> Reader:
    pose = look_at(np.array([3.0, 1.0, 1.5]), np.zeros(3))
    path = {
        "camera_type": "perspective",
        "render_width": 64,
        "render_height": 48,
        "fps": 24,
        "seconds": 2.0,
        "crop": None,
        "camera_path": [{"camera_to_world": pose.reshape(-1).tolist(), "fov": 50.0, "aspect": 1.3}] * 2,
    }
    views = {
        "format_version": 1,
        "space": "world",
        "camera_model": "OPENCV",
        "w": 20,
        "h": 16,
        "fl_x": 28.0,
        "k1": 0.01,
        "fps": 12.5,
        "frames": [
            {"name": name, "transform_matrix": pose.tolist(), "cx": 9.0} for name in ("left", "right")
        ],
    }
    frame = Normalisation(np.eye(3), np.array([0.1, 0.2, 0.3]), 0.5)
    samples = tuple(json.dumps(content).encode() for content in (path, views))
    return Reader(samples, "camera.json", partial(_read_cameras, frame), (ConfigError,), mutate_json)


def _read_cameras(frame: Normalisation, path: Path) -> None:
    for view in read_camera_file(path, frame).views:
        assert bool(view.camera.focal_px.isfinite().all() and (view.camera.focal_px > 0).all())
        assert bool(view.camera.camera_to_world.isfinite().all())


def _index_formula() -> Reader:
    samples = (
        b"(r800-r670)/(r800+r670)",
        b"2.5 * (R860.5 - r650) / (r860.5 + 6*r650 - 7.5e0*r470 + 1)",
        b"max(sqrt(r550), -log(r700) ^ 2, min(r400, abs(exp(r500)))) ** -.5",
    )
    return Reader(samples, "formula.txt", _read_formula, (ConfigError,))


def _read_formula(path: Path) -> None:
    formula = parse_formula(path.read_bytes().decode("utf-8", "replace"))
    value = formula.evaluate(lambda nm: torch.tensor([0.5, 0.0, 1.0]) / nm, torch.zeros(1))
    assert not bool(value.isinf().any())


def _config() -> Reader:
    content = {"format_version": RUN_FORMAT, "config": config_to_json(find_method("unmix-nerf").config)}
    samples = (json.dumps(content).encode(),)
    beside = (("scene.json", b"{}"),)
    return Reader(samples, "config.json", _read_config, (RunError,), mutate_json, beside)


def _read_config(path: Path) -> None:
    config = load_config(path.parent)
    assert config.pipeline.model.eval_num_rays_per_chunk > 0


def _scene_record() -> Reader:
    pose = torch.tensor(look_at(np.array([3.0, 1.0, 1.5]), np.zeros(3))[:3], dtype=torch.float32)
    ones = torch.ones(2, 2)
    cameras = Cameras(torch.stack([pose, pose]), 28 * ones, 8 * ones, torch.zeros(2, 4), 20, 16).to_json()
    metadata = {
        "wavelengths_nm": [450.0, 520.0, 680.0],
        "illuminant": [1.0, 0.9, 0.8],
        "has_alpha": True,
        "grid_resolution": 16,
        "pixel_size": 0.02,
        "subpixels": 2,
    }
    summary = {
        "root": "/scenes/pots",
        "wavelengths_nm": metadata["wavelengths_nm"],
        "frames": ["a", "b", "c", "d"],
        "train_indices": [0, 2],
        "eval_indices": [1, 3],
        "normalisation": Normalisation(np.eye(3), np.array([0.1, 0.2, 0.3]), 0.5).to_json(),
        "material_names": ["leaf", "clay"],
        "endmembers": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]],
        "input_hashes": {"transforms.json": "00"},
        "options": asdict(SceneOptions()),
    }
    content = {
        "format_version": RUN_FORMAT,
        "scene_box": [[-1, -1, -1], [1, 1, 1.5]],
        "metadata": metadata,
        "train_cameras": cameras,
        "eval_cameras": cameras,
        "summary": summary,
    }
    samples = (json.dumps(content).encode(),)
    return Reader(samples, "scene.json", _read_scene_record, (RunError,), mutate_json)


def _read_scene_record(path: Path) -> None:
    scene = read_scene_record(RunFolder(path.parent), HyperspectralDataManager)
    world_frame(scene)
    for view in recorded_views(scene):
        assert (path.parent / view.name).parent == path.parent


def _checkpoint() -> dict[str, bytes]:
    """Files of a checkpoint by suffix."""
    tensors = safetensors.torch.save({"model/a": torch.ones(2, 3), "model/n": torch.tensor(2)})
    record = TrainingRecord(2, 0.5, 100, 0, 50, 1, 0.2, {"grid": 0.01}).to_json()
    record = {
        "format_version": RUN_FORMAT,
        **record,
        "step": 2,
        "sha256": hashlib.sha256(tensors).hexdigest(),
    }
    return {".json": json.dumps(record).encode(), ".safetensors": tensors}


def _checkpoint_record() -> Reader:
    files = _checkpoint()
    beside = (("step-000002.safetensors", files[".safetensors"]),)
    read = _read_checkpoint
    return Reader((files[".json"],), "step-000002.json", read, (RunError,), mutate_json, beside)


def _checkpoint_tensors() -> Reader:
    return Reader((_checkpoint()[".safetensors"],), "step-000002.safetensors", _read_tensors, (RunError,))


def _read_tensors(path: Path) -> None:
    """With the right hash, as only malice makes it."""
    record = {**json.loads(_checkpoint()[".json"]), "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    path.with_suffix(".json").write_text(json.dumps(record))
    _read_checkpoint(path)


def _read_checkpoint(path: Path) -> None:
    found = newest_complete_checkpoint(path.parent)
    if found is None:
        raise RunError("none")
    TrainingRecord.from_json(found.record)


def _metrics() -> Reader:
    lines = [json.dumps({"step": step, "split": "train", "loss": 0.5}) + "\n" for step in range(3)]
    return Reader(("".join(lines).encode(),), "metrics.jsonl", _read_metrics, (RunError,))


def _read_metrics(path: Path) -> None:
    before = path.read_bytes()
    _keep_until(path, 2)  # the part of MetricsWriter that reads; TensorBoard's would start a thread a case
    for line in path.read_text(encoding="utf-8").splitlines():
        assert json.loads(line)["step"] <= 2
    if path.read_bytes() != before:
        raise RunError("lines were dropped")


_RECIPE = b"""\
illuminant: {light: D65, extrapolate: true}
edits:
- swap: &both [0, wood]
- replace: {endmember: 2, library: checker/red}
- replace: {endmember: 3, file: paints.csv, spectrum: ochre, extrapolate: yes}
- retint: {endmember: 4, colour: '#3366cc', match: spectrum}
- scale: {endmember: 0, factor: 1.5}
- remove: *both
- isolate: [7]
- rename: {endmember: 1, name: red brick}
- gloss: {endmember: 1, scale: 0, colour: [1, .5, 0]}
"""


def _recipe() -> Reader:
    recipe_from_yaml("illuminant: A")  # imports colour-science: seconds that no case is to blame for
    samples = (_RECIPE, b"illuminant: lamp.csv\n", b"%YAML 1.1\n---\nedits: [remove: !!int '0x1f']\n...\n")
    return Reader(samples, "edits.yml", _read_recipe, (ConfigError,))


def _read_recipe(path: Path) -> None:
    recipe = read_recipe(path)
    written = recipe_to_yaml(recipe)
    written.encode()
    assert recipe_from_yaml(written, folder=path.parent) == recipe


def _capture(file_name: str) -> Reader:
    beside = (("cube", ENVI_DATA),) if file_name == "cube.hdr" else ()
    return Reader(SAMPLES[file_name](), file_name, read_capture, (CaptureError,), companions=beside)


def _poses(
    name: str,
    samples: Callable[[], tuple[bytes, ...]],
    mutate: Mutator = mutate_bytes,
    companions: tuple[tuple[str, bytes], ...] = (),
) -> Reader:
    return Reader(samples(), name, pose_samples.read_and_place, (CaptureError,), mutate, companions)


def _colmap(name: str) -> Reader:
    """One of COLMAP's text files, damaged, beside the others."""
    files = {
        "cameras.txt": pose_samples.COLMAP_CAMERAS,
        "images.txt": pose_samples.COLMAP_IMAGES,
        "points3D.txt": pose_samples.COLMAP_POINTS,
    }
    beside = tuple((other, content) for other, content in files.items() if other != name)
    return _poses(name, lambda: (files[name],), companions=beside)


def _ply() -> Reader:
    return Reader(pose_samples.ply_samples(), "points.ply", pose_samples.read_points, (ValueError,))


_CALIBRATION = (("AutoCal.xml", pose_samples.CALIBRATED),)
READERS: dict[str, Callable[[], Reader]] = {
    "transforms.json": _transforms,
    "cube (.npy)": _cube,
    "picture": _picture,
    "label picture": _labels,
    "ENVI header": _envi_header,
    "ENVI values": _envi_values,
    "spectra CSV": _spectra_csv,
    "camera file": _cameras,
    "index formula": _index_formula,
    "run config": _config,
    "run scene": _scene_record,
    "checkpoint record": _checkpoint_record,
    "checkpoint tensors": _checkpoint_tensors,
    "run metrics": _metrics,
    "recipe": _recipe,
    "poses transforms.json": partial(_poses, "transforms.json", pose_samples.transforms_samples, mutate_json),
    "poses OpenSfM": partial(_poses, "reconstruction.json", pose_samples.opensfm_samples, mutate_json),
    "poses Metashape": partial(_poses, "cameras.xml", pose_samples.metashape_samples),
    "poses MicMac": partial(
        _poses, "Orientation-a.tif.xml", pose_samples.micmac_samples, companions=_CALIBRATION
    ),
    "poses LLFF": partial(_poses, "poses_bounds.npy", pose_samples.llff_samples),
    **{
        f"poses COLMAP {name}": partial(_colmap, name)
        for name in ("cameras.txt", "images.txt", "points3D.txt")
    },
    "points (.ply)": _ply,
    **{f"capture {file_name}": partial(_capture, file_name) for file_name in SAMPLES},
}
"""By name, for messages and tables."""
