"""Every reader of files that strangers make: valid samples, how to read damaged ones, and what it may raise.

A reader gets the damaged bytes as a file, and either reads them or raises one of the errors that it promises. To add
one, write a function that makes a `Reader` and name it in `READERS`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from tests.fuzz import pose_samples, run_readers, scene_readers
from tests.fuzz.capture_samples import ENVI_DATA, SAMPLES, read_capture, read_with_xml, xml_beside
from tests.fuzz.mutation import Mutator, Reader, mutate_bytes, mutate_json, mutate_zip
from tests.fuzz.object_readers import environment_reader, mesh_reader, picture_reader, transforms_reader
from unmix_plugin.errors import CaptureError


def _capture(file_name: str) -> Reader:
    beside = (("cube", ENVI_DATA),) if file_name == "cube.hdr" else ()
    mutate = mutate_zip if file_name.endswith((".npz", ".pt")) else mutate_bytes
    return Reader(SAMPLES[file_name](), file_name, read_capture, (CaptureError,), mutate, beside)


def _xml_beside(file_name: str) -> Reader:
    beside = (("cube.tif", SAMPLES["cube.tif"]()[0]),)
    return Reader(xml_beside(), file_name, read_with_xml, (CaptureError,), companions=beside)


def _poses(
    name: str,
    samples: Callable[[], tuple[bytes, ...]],
    mutate: Mutator = mutate_bytes,
    companions: tuple[tuple[str, bytes], ...] = (),
) -> Reader:
    return Reader(samples(), name, pose_samples.read_and_place, (CaptureError,), mutate, companions)


def _colmap(name: str) -> Reader:
    """One of COLMAP's files, damaged, beside the others."""
    files = pose_samples.colmap_files(name.endswith(".bin"))
    beside = tuple((other, content) for other, content in files.items() if other != name)
    return _poses(name, lambda: (files[name],), companions=beside)


def _ply() -> Reader:
    return Reader(pose_samples.ply_samples(), "points.ply", pose_samples.read_points, (ValueError,))


_ORIENTATION = (("Orientation-a.tif.xml", pose_samples.micmac_samples()[0]),)
_COLMAP_FILES = [f"{part}.{suffix}" for suffix in ("txt", "bin") for part in pose_samples.COLMAP_PARTS]
_CALIBRATION = (("AutoCal.xml", pose_samples.CALIBRATED),)
READERS: dict[str, Callable[[], Reader]] = {
    "transforms.json": scene_readers.transforms_reader,
    "cube (.npy)": scene_readers.cube_reader,
    "picture": scene_readers.picture_reader,
    "label picture": scene_readers.labels_reader,
    "ENVI header": scene_readers.envi_header_reader,
    "ENVI values": scene_readers.envi_values_reader,
    "spectra CSV": scene_readers.spectra_csv_reader,
    "camera file": scene_readers.cameras_reader,
    "index formula": scene_readers.index_formula_reader,
    "run config": run_readers.config_reader,
    "run scene": run_readers.scene_record_reader,
    "checkpoint record": run_readers.checkpoint_record_reader,
    "checkpoint tensors": run_readers.checkpoint_tensors_reader,
    "run metrics": run_readers.metrics_reader,
    "recipe": run_readers.recipe_reader,
    "viewer message": run_readers.viewer_message_reader,
    "poses transforms.json": partial(_poses, "transforms.json", pose_samples.transforms_samples, mutate_json),
    "poses OpenSfM": partial(_poses, "reconstruction.json", pose_samples.opensfm_samples, mutate_json),
    "poses Metashape": partial(_poses, "cameras.xml", pose_samples.metashape_samples),
    "poses MicMac": partial(
        _poses, "Orientation-a.tif.xml", pose_samples.micmac_samples, companions=_CALIBRATION
    ),
    "poses MicMac AutoCal.xml": partial(
        _poses, "AutoCal.xml", lambda: (pose_samples.CALIBRATED,), companions=_ORIENTATION
    ),
    "poses LLFF": partial(_poses, "poses_bounds.npy", pose_samples.llff_samples),
    **{f"poses COLMAP {name}": partial(_colmap, name) for name in _COLMAP_FILES},
    "points (.ply)": _ply,
    **{f"capture {file_name}": partial(_capture, file_name) for file_name in SAMPLES},
    "capture cube.tif.aux.xml": partial(_xml_beside, "cube.tif.aux.xml"),
    "sensor CSV": scene_readers.responses_reader,
    "library text": scene_readers.library_text_reader,
    "wavelengths CSV": scene_readers.wavelengths_reader,
    "angles CSV": scene_readers.angles_reader,
    "run measures": run_readers.measures_reader,
    **{f"object mesh.{kind}": partial(mesh_reader, kind) for kind in ("ply", "obj", "glb", "gltf")},
    **{f"object environment.{kind}": partial(environment_reader, kind) for kind in ("exr", "hdr")},
    "object picture.exr": partial(picture_reader, "images/000.exr"),
    "object picture.npy": partial(picture_reader, "spectral/cubes/000.npy"),
    "object transforms.json": transforms_reader,
}
"""By name, for messages and tables."""
