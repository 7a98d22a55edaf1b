"""Readers of what a scene holds, with valid samples: poses, cubes, pictures, spectra, camera files, formulas."""

from __future__ import annotations

import io
import json
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from tests.factories.scenes import look_at
from tests.fuzz.mutation import Reader, mutate_json, mutate_png
from unmix_plugin.captures.poses.turntable_observations import parse_angles
from unmix_plugin.captures.wavelengths import parse_bands
from unmix_plugin.errors import ConfigError, SceneError, SpectrumError
from unmix_plugin.formats.libraries import read_library
from unmix_plugin.scenes.reading.cubes import UnreadableArrayError, measure_cube, read_array_header
from unmix_plugin.scenes.reading.entries import locate_files, read_entries
from unmix_plugin.scenes.reading.faults import Faults
from unmix_plugin.scenes.reading.images import UnreadableImageError, read_colour, read_labels, read_mask
from unmix_plugin.scenes.reading.splits import split_frames
from unmix_plugin.scenes.scene import Normalisation
from unmix_plugin.settings import SceneOptions
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import read_spectra
from unmix_plugin.spectral.maps.indices import parse_formula
from unmix_plugin.spectral.sensor import read_sensor
from unmix_plugin.trained.camera_files import read_camera_file

_SIZE = (16, 20)


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


def transforms_reader() -> Reader:
    pose = look_at(np.array([3.0, 1.0, 1.5]), np.zeros(3)).tolist()
    frames = [
        {"hyperspectral_file_path": f"cubes/{name}.npy", "file_path": f"{name}.png", "transform_matrix": pose}
        for name in ("train_0", "eval_1", "train_2")
    ]
    frames[0] |= {"mask_path": "mask.png", "seg_file_path": "s.png", "abundance_file_path": "a.npy"}
    frames[0] |= {"k1": 0.1, "fl_x": 20}
    lens = {"w": 20, "h": 16, "fl_x": 28.0, "fl_y": 28.5, "cx": 10.0, "cy": 8.0, "p1": 0.0}
    whole = {"camera_model": "OPENCV", **lens, "wavelengths": [450.0, 520.0, 600.5, 680], "frames": frames}
    whole |= {"illuminant_path": "illuminant.csv", "endmembers_path": "endmembers.csv"}
    whole |= {"materials": ["leaf", "clay"], "test_filenames": ["eval_1.png"]}
    whole |= {"train_filenames": ["train_0.png", "train_2.png"]}
    bare = {"camera_angle_x": 0.7, "distortion_params": [0.1, 0, 0, 0, 0, 0.2]}
    bare |= {"wavelengths": [400, 500], "frames": frames[1:]}
    samples = tuple(json.dumps(content).encode() for content in (whole, bare))
    named = {path for frame in frames for key, path in frame.items() if key.endswith("_path")}
    beside = tuple((str(path), b"") for path in sorted(named))
    return Reader(samples, "transforms.json", _read_transforms, (SceneError,), mutate_json, beside)


def _read_transforms(path: Path) -> None:
    faults = Faults(path.parent)
    entry = read_entries(path.parent, faults)
    locate_files(path.parent, entry, False, faults)
    for method in ("auto", "filename", "interval"):
        split_frames(entry, method, 2, faults)
    for frame in entry.frames:
        if frame.camera.lens is not None:
            focal = np.array(frame.camera.lens.focal_at(20, 30), dtype=np.float32)
            assert np.isfinite(focal).all()
            assert focal.min() > 0
    faults.raise_if_any()


def cube_reader() -> Reader:
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
        values = measure_cube(path, SceneOptions())
        assert 0 <= values.num_invalid_pixels <= values.num_pixels


def picture_reader() -> Reader:
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


def labels_reader() -> Reader:
    labels = Image.fromarray(np.random.default_rng(0).integers(0, 5, _SIZE, dtype=np.uint8))
    samples = [_encoded(labels, name) for name in ("PNG", "TIFF", "JPEG")]
    samples += [_encoded(labels.convert("P"), "PNG"), *picture_reader().samples[:2]]
    allowed = (UnreadableImageError,)
    return Reader(tuple(samples), "labels.png", lambda path: read_labels(path, _SIZE), allowed, mutate_png)


def envi_header_reader() -> Reader:
    other = _ENVI.replace("data type = 4", "data type = 13").replace("Micrometers", "nm").replace("0.", "1")
    plain = "\n".join(line for line in other.splitlines() if "factor" not in line and "ignore" not in line)
    samples = tuple(text.encode() for text in (_ENVI, other, plain, _ENVI.replace("\n", "\r\n")))
    beside = (("library.sli", np.linspace(0, 9000, 6).astype("<f4").tobytes()),)
    return Reader(samples, "library.hdr", read_library, (SpectrumError,), companions=beside)


def envi_values_reader() -> Reader:
    samples, beside = (np.linspace(0, 9000, 6).astype("<f4").tobytes(),), (("library.hdr", _ENVI.encode()),)
    return Reader(samples, "library.sli", read_library, (SpectrumError,), companions=beside)


def spectra_csv_reader() -> Reader:
    samples = (
        b"wavelength,leaf,clay\n450,0.1,0.2\n520,0.3,0.5\n600,0.1,0.8\n",
        b'\xef\xbb\xbfwavelength_nm,"power, relative"\r\n\r\n400.5,1\r\n500,2e-3\r\n',
    )
    return Reader(samples, "spectra.csv", read_spectra, (SpectrumError,))


def responses_reader() -> Reader:
    samples = (b"wavelength,red,green\n450,0,0.1\n520,0.2,1\n600,1,0.1\n",)
    bands = Bands(np.array([450.0, 500.0, 550.0, 600.0]))

    def read(path: Path) -> None:
        assert np.isfinite(read_sensor(path).seen_by(bands).matrix).all()

    return Reader(samples, "sensor.csv", read, (SpectrumError,))


def library_text_reader() -> Reader:
    head = "Name: oak\nX Units: Wavelength (micrometers)\nY Units: Reflectance (percent)\n\n"
    usgs = "USGS Digital Spectral Library splib06a\nline\nOak_Leaf\nfir\n 0.45 0.1 0.01\n 0.55 -1.23e34 0\n"
    record = " splib07a Record=1234: Oak_Leaf-1 fresh\n 0.1\n 0.25\n -1.23e+034\n"
    samples = (f"{head}0.45\t10\n0.55\t25.5\n0.65\t50\n".encode(), usgs.encode(), record.encode())
    beside = (("s07_Wavelengths_1.txt", b" Record=1: Wavelengths\n 0.45\n 0.55\n 0.65\n"),)
    return Reader(samples, "oak.txt", read_library, (SpectrumError,), companions=beside)


def wavelengths_reader() -> Reader:
    samples = (b"wavelength,width\n450,5\n520.5,5\n", b"450\n520\n600\n", b"450.5,520,600\n")
    return Reader(samples, "bands.csv", lambda path: parse_bands(str(path)), (ConfigError,))


def angles_reader() -> Reader:
    samples = (b"view,angle,camera\na,0,1\nb.png,120,1\nc,240.5,2\n",)
    return Reader(samples, "angles.csv", lambda path: parse_angles(str(path), "abc"), (ConfigError,))


def cameras_reader() -> Reader:
    pose = look_at(np.array([3.0, 1.0, 1.5]), np.zeros(3))
    keys = [{"camera_to_world": pose.reshape(-1).tolist(), "fov": 50.0, "aspect": 1.3}] * 2
    path = {"camera_type": "perspective", "render_width": 64, "render_height": 48, "camera_path": keys}
    path |= {"fps": 24, "seconds": 2.0, "crop": None}
    frames = [{"name": name, "transform_matrix": pose.tolist(), "cx": 9.0} for name in ("left", "right")]
    lens = {"camera_model": "OPENCV", "w": 20, "h": 16, "fl_x": 28.0, "k1": 0.01}
    views = {"format_version": 1, "space": "world", **lens, "fps": 12.5, "frames": frames}
    frame = Normalisation(np.eye(3), np.array([0.1, 0.2, 0.3]), 0.5)
    samples = tuple(json.dumps(content).encode() for content in (path, views))
    return Reader(samples, "camera.json", partial(_read_cameras, frame), (ConfigError,), mutate_json)


def _read_cameras(frame: Normalisation, path: Path) -> None:
    for view in read_camera_file(path, frame).views:
        assert bool(view.camera.focal_px.isfinite().all() and (view.camera.focal_px > 0).all())
        assert bool(view.camera.camera_to_world.isfinite().all())


def index_formula_reader() -> Reader:
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
