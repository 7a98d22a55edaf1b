"""Readers of files that strangers make either read them or refuse them with the error that they promise."""

import contextlib

import pytest

from tests.fuzz.fuzzing import fuzz, prepare
from tests.fuzz.readers import READERS

CASES = 200
"""A reader, for a few seconds in all; `python benchmarks/fuzz.py` runs many more."""
SLOWEST_S, MOST_BYTES = 5.0, 10**9
WITH_REFUSED_SAMPLES = ("picture", "label picture")
"""Some of their samples are of a format or a mode that isn't accepted."""
_SIGNALLING = b"\x01\0\0\0\0\0\xf0\x7f"
"""A NaN at which the processor says that it is none, as float64; its second half for float32."""
FOUND = (
    ("cube (.npy)", 2, b"", _SIGNALLING),
    ("camera file", 0, b'"fov": 50.0', b'"fov": 1e-320'),
    ("run metrics", 0, b'{"step": 0', b'\xef\xbb\xbf{"step": 0'),
    ("run metrics", 0, b'{"step": 1', b'\xef\xbb\xbf{"step": 1'),
    ("poses MicMac", 0, b"AutoCal.xml", b"AutoCal.xml" + 400 * b"9"),
    ("poses LLFF", 1, b"", b"\x01\0\x80\x7f"),
    ("poses Metashape", 0, b'ted"><resolution width="', b'ted"><resolution width="' + 5000 * b"9"),
    ("poses Metashape", 0, b" 3.872983346207417 1.0", b" 1e300 1.0"),
    ("points (.ply)", 0, b"vertex 2", b"vertex 2" + 30 * b"0"),
    ("poses COLMAP cameras.txt", 0, b"64 48 90 90", b"64 48 90 1e90"),
    ("poses COLMAP cameras.txt", 0, b"64 48 90 90", b"64 48 1e-320 90"),
    ("poses COLMAP images.txt", 0, b"1 1 0 0 0 0", b"1 1 0 0 1e200 0"),
    ("poses COLMAP points3D.txt", 0, b"2 1 2 3", b"2 -1e308 2 3"),
    ("points (.ply)", 0, b"vertex 2", b"vertex"),
    ("points (.ply)", 0, b"255 0 3", b"255 0 nan"),
    ("points (.ply)", 0, b"0 1 2 255 0 3\n4 5 6 1 2 3", b""),
    ("object mesh.obj", 0, b"v 0.0", b"v 1e300 0.0"),
    ("object mesh.obj", 0, b"\nf", b"\nvn 1\nf"),
    ("object mesh.gltf", 0, b'"mesh":0', b'"mesh":0,"scale":[NaN,1,1]'),
    ("object environment.hdr", 0, b"-Y 8", b"\xd0Y 8"),
    ("object picture.exr", 0, b"scanlineimage", b"scanlineimagf"),
    ("library text", 2, b" 0.25\n", b" 0.25\n ,\n"),
)
"""What fuzzing found once: reader, sample, and what was exchanged for what; the end of the sample where the former is
empty."""


@pytest.mark.parametrize("name", READERS)
def test_valid_samples_are_read_or_refused_as_promised(name, tmp_path):
    reader = READERS[name]()
    path = prepare(reader, tmp_path)
    for data in reader.samples:
        path.write_bytes(data)
        try:
            reader.read(path)
        except reader.allowed:
            assert name in WITH_REFUSED_SAMPLES


@pytest.mark.parametrize(("name", "sample", "old", "new"), FOUND)
def test_what_was_found_once_is_read_or_refused_as_promised(name, sample, old, new, tmp_path):
    reader = READERS[name]()
    data = reader.samples[sample]
    assert old in data
    path = prepare(reader, tmp_path)
    path.write_bytes(data.replace(old, new, 1) if old else data[: -len(new)] + new)
    with contextlib.suppress(*reader.allowed):
        reader.read(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_raise_only_what_the_reader_promises(name, tmp_path):
    outcome = fuzz(name, tmp_path, seed=0, cases=range(CASES))
    assert outcome.cases == CASES
    assert outcome.foreign == []
    assert outcome.slowest_s < SLOWEST_S, f"case {outcome.slowest_case}"
    assert outcome.most_bytes < MOST_BYTES, f"case {outcome.largest_case}"
    assert outcome.accepted < CASES
