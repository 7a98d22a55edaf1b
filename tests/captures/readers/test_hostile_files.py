"""Small files that would take endless work or memory: refused before anything of them is decoded, in one message."""

from __future__ import annotations

import io
import struct
import time
import zipfile
import zlib
from collections.abc import Callable
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image

from tests.factories.data_sets import write_exr
from tests.factories.files import header_text
from tests.factories.systems import most_memory
from unmix_plugin import limits
from unmix_plugin.captures.readers.opening import inspect_file, open_spectral_file
from unmix_plugin.errors import CaptureError

CUBE = np.arange(60, dtype=np.uint16).reshape(5, 4, 3)
ZEROS = np.zeros((900, 900), np.uint8)
_MATLAB_BEGIN = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x100) + b"IM"


def _element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def looping_pages(path: Path, big: bool = False) -> None:
    """A TIFF whose second page, or whose only one, leads back to the first."""
    first_at, count, entry, number = (8, "<Q", 20, "<Q") if big else (4, "<H", 12, "<I")
    with tifffile.TiffWriter(path, bigtiff=big) as file:
        for _ in range(1 if big else 2):
            file.write(CUBE[..., 0], metadata=None, contiguous=False)
    data = bytearray(path.read_bytes())
    size = struct.calcsize(number)
    leads = 0
    first = page = struct.unpack(number, data[first_at : first_at + size])[0]
    for _ in range(1 if big else 2):
        tags = struct.unpack_from(count, data, page)[0]
        leads = page + struct.calcsize(count) + entry * tags
        page = struct.unpack_from(number, data, leads)[0]
    data[leads : leads + size] = struct.pack(number, first)
    path.write_bytes(data)


def many_pages(path: Path) -> None:
    with tifffile.TiffWriter(path) as file:
        for _ in range(limits.MOST_PARTS + 1):
            file.write(CUBE[..., 0], metadata=None, contiguous=False)


def many_members(path: Path) -> None:
    file = io.BytesIO()
    np.save(file, np.zeros(1))
    with zipfile.ZipFile(path, "w") as archive:
        for index in range(limits.MOST_PARTS + 1):
            archive.writestr(f"{index}.npy", file.getvalue())


def nested_groups(path: Path) -> None:
    with h5py.File(path, "w") as file:
        group: h5py.Group = file
        for _ in range(2 * limits.DEEPEST):
            group = group.create_group("g")
        file["cube"] = CUBE


def packed_chunk(path: Path) -> None:
    with h5py.File(path, "w") as file:
        options = {"chunks": (900, 900, 3), "maxshape": (None, None, 3), "compression": "gzip"}
        file.create_dataset("cube", (5, 4, 3), "u1", **options)[:] = 1


def empty_numbers(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("cube", (10**4, 10**4, 100), "f8", chunks=(10, 10, 10))


def many_wavelengths(path: Path) -> None:
    """A list of as many wavelengths as the image claims to have bands, of which nothing is in the file."""
    with h5py.File(path, "w") as file:
        file.create_dataset("cube", (1, 1, 10**9), "f4", chunks=(1, 1, 1000))
        file.create_dataset("wavelength", (10**9,), "f4", chunks=(1000,))
        file["cube"].attrs["wavelength_units"] = "nm"


def many_bands(path: Path) -> None:
    path.write_text(header_text(np.zeros((1, 1, 1), np.uint8), "bip", {"bands": 50_000_000}))
    path.with_suffix("").write_bytes(b"0")


def packed_variable(path: Path) -> None:
    size = 900 * 900
    head = _element(6, struct.pack("<II", 9, 0)) + _element(5, struct.pack("<3i", 900, 900, 1))
    head += _element(1, b"cube") + struct.pack("<II", 2, size)
    packed = zlib.compress(struct.pack("<II", 14, len(head) + size) + head + bytes(size))
    path.write_bytes(_MATLAB_BEGIN + struct.pack("<II", 15, len(packed)) + packed)


def many_variables(path: Path) -> None:
    head = _element(6, struct.pack("<II", 6, 0)) + _element(5, struct.pack("<2i", 1, 1))
    one = _element(14, head + _element(1, b"x") + _element(9, bytes(8)))
    path.write_bytes(_MATLAB_BEGIN + one * (limits.MOST_PARTS + 1))


def many_parts(path: Path, attributes: bool) -> None:
    with h5py.File(path, "w", libver="latest") as file:
        file["cube"] = CUBE
        for index in range(limits.MOST_PARTS + 1):
            if attributes:
                file["cube"].attrs[str(index)] = index
            else:
                file.create_group(str(index))


@contextmanager
def quick():
    """A few seconds of work at most."""
    begun = time.process_time()
    yield
    assert time.process_time() - begun < 2


MANY_TAGS = b"II*\0" + struct.pack("<IH", 8, 60_000) + bytes(12 * 60_000 + 4)
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "loop.tif": (looping_pages, "page 2 leads back to an earlier one"),
    "big-loop.tif": (partial(looping_pages, big=True), "page 1 leads back to an earlier one"),
    "pages.tif": (many_pages, "101 pages; expected at most 100"),
    "tags.tif": (lambda path: path.write_bytes(MANY_TAGS), "60000 tags in page 1"),
    "strip.tif": (partial(tifffile.imwrite, data=ZEROS, compression="zlib", rowsperstrip=900), "to 810,000"),
    "picture.png": (lambda path: Image.fromarray(ZEROS).save(path), "decode to 810,000"),
    "members.npz": (many_members, "101 members; expected at most 100"),
    "packed.npz": (partial(np.savez_compressed, cube=ZEROS[..., None]), "decode to 810,128"),
    "nested.h5": (nested_groups, "33 levels deep; expected at most 32"),
    "groups.h5": (partial(many_parts, attributes=False), "101 groups and data sets"),
    "attributes.h5": (partial(many_parts, attributes=True), "101 attributes"),
    "chunk.h5": (packed_chunk, "decode to 2,430,000"),
    "empty.h5": (empty_numbers, "decode to 80,000,000,000"),
    "wavelengths.h5": (many_wavelengths, "1000000000 bands; expected at most 65536"),
    "bands.hdr": (many_bands, "'bands' is 50000000; expected at most 65536"),
    "items.hdr": (
        lambda path: path.write_text("ENVI\nwavelength = {" + "1," * (1 << 20) + "}"),
        "1,048,577 items",
    ),
    "packed.mat": (packed_variable, "decode to 810,000"),
    "variables.mat": (many_variables, "101 variables"),
    "packed.exr": (lambda path: write_exr(path, {"S0.450,0nm": ZEROS}), "decode to 3,240,000"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_would_take_endless_work_is_refused_before_it_is_decoded(tmp_path, monkeypatch, name):
    monkeypatch.setattr(limits, "FREE_BYTES", 1 << 19)
    monkeypatch.setattr(limits, "MOST_RATIO", 1)
    monkeypatch.setattr(limits, "MOST_PARTS", 100)
    write, message = HOSTILE[name]
    write(tmp_path / name)
    before = most_memory()
    with quick(), pytest.raises(CaptureError, match=message) as refused:
        open_spectral_file(tmp_path / name)
    assert most_memory() - before < 200_000_000
    assert name in str(refused.value)
    assert "expected" in str(refused.value)


LONG = 100_000
SLOW: dict[str, str] = {
    "spaces": "note = a" + " " * LONG + "b",
    "units": "wavelength units = a" + " " * LONG + "b",
    "a long name": "band names = {" + "b" * LONG + "1, " + "-" * LONG + "2, " + "1 " * LONG + "}",
    "empty lines": "note =" + "\n" * LONG,
    "entries": "a =\n" * LONG,
    "braces": "description = {" + "{" * LONG + "}",
    "descriptions": "description = {\n" * (LONG // 4) + "}",
    "commas": "wavelength = {" + "," * LONG + "}",
    "lines that are no entries": "x\n" * LONG,
    "lists in brackets that never end": "a = [\n" * LONG,
    "lists in brackets that end far away": "a = [ 3\n" * LONG + "]",
}


@pytest.mark.parametrize("name", [*SLOW, "names of bands"])
def test_a_long_header_takes_time_in_proportion_to_its_length(tmp_path, name):
    count = 20_000 if name == "names of bands" else 0
    names = ",".join(f"{450 + index}" for index in range(count))
    cube = np.zeros((1, 1, count), np.uint8) if count else CUBE
    (tmp_path / "a.img").write_bytes(cube.tobytes())
    more = f"band names = {{{names}}}" if count else SLOW[name]
    (tmp_path / "a.hdr").write_text(header_text(cube, "bip", {}) + more + "\n")
    with quick():
        inspect_file(tmp_path / "a.hdr")


RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
NESTED = f'<rdf:RDF xmlns:rdf="{RDF}">{"<rdf:Description>" * 20_000}{"</rdf:Description>" * 20_000}</rdf:RDF>'
HALF = f'<rdf:RDF xmlns:rdf="{RDF}"><rdf:Description BandFreq="560+{" " * LONG}x"/></rdf:RDF>'


@pytest.mark.parametrize(
    ("text", "code"),
    [
        pytest.param("wavelength" * LONG, 270, id="one word"),
        pytest.param("wavelength <Channel " * (LONG // 4), 270, id="unclosed"),
        pytest.param("wavelength = " + " " * LONG + "x", 270, id="spaces"),
        pytest.param(NESTED, 700, id="nested"),
        pytest.param(HALF, 700, id="half a width"),
    ],
)
def test_a_long_description_takes_time_in_proportion_to_its_length(tmp_path, text, code):
    tag = (code, "B" if code == 700 else "s", len(text) if code == 700 else 0, text.encode(), True)
    tifffile.imwrite(tmp_path / "a.tif", CUBE, photometric="minisblack", metadata=None, extratags=[tag])
    with quick():
        open_spectral_file(tmp_path / "a.tif")


def test_what_is_no_regular_file_is_not_opened(tmp_path):
    with pytest.raises(OSError, match="is no regular file"):
        limits.open_regular(tmp_path)
    (tmp_path / "a").write_bytes(b"long")
    with pytest.raises(OSError, match="and 3 at most are read"):
        limits.read_bounded(tmp_path / "a", 3)
    assert limits.read_bounded(tmp_path / "a", 4) == b"long"


def _damage_every_byte(folder: str) -> None:
    path = Path(folder) / "cube.h5"
    with h5py.File(path, "w") as file:
        file["cube"] = CUBE
    sound = path.read_bytes()
    for position in range(len(sound)):
        path.write_bytes(sound[:position] + b"\x91" + sound[position + 1 :])
        _open(path)


@pytest.mark.slow
def test_no_damaged_byte_of_hdf5_ends_the_process(tmp_path):
    assert _exit_code(_damage_every_byte, str(tmp_path)) == 0


def test_names_of_hdf5_that_lead_back_to_themselves_end(tmp_path):
    path = tmp_path / "cube.h5"
    with h5py.File(path, "w") as file:
        file["a/cube"] = CUBE
        file["a/again"] = file["a"]
        file["same"] = file["a/cube"]
    np.testing.assert_array_equal(open_spectral_file(path).read(slice(None)), CUBE)
    data = bytearray(path.read_bytes())
    node = data.index(b"TREE")  # of version 1: its right sibling follows 16 bytes later
    while node >= 0:
        data[node + 16 : node + 24] = struct.pack("<Q", node)
        node = data.find(b"TREE", node + 1)
    path.write_bytes(data)
    assert _exit_code(_open, path) == 0


def _open(path: Path) -> None:
    with suppress(CaptureError):
        open_spectral_file(path)


def _exit_code(work: Callable[..., None], argument: Path | str) -> int | None:
    """How a process of its own ends, which libraries may end or keep from ending; it is killed after two minutes."""
    process = get_context("spawn").Process(target=work, args=(argument,))
    process.start()
    process.join(120)
    process.kill()
    process.join()
    return process.exitcode
