"""Files of instruments for tests: in memory, as multispectral cameras write them, and small ENVI images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from unmix_plugin.captures.cube import BandTable, Cube, Exposure, Factor
from unmix_plugin.captures.numbers import Held, Numbers
from unmix_plugin.captures.report import Kind, sentences


def exposure_of_file(
    time: float | list[float] | None = None,
    gain: float | list[float] | None = None,
    f_number: float | None = None,
    source: str = "",
    assumed: str = "",
) -> Exposure:
    """An exposure with these factors; where its time is stated, and the unit that is assumed."""
    stated = [None if each is None else tuple(np.atleast_1d(each).tolist()) for each in (time, gain)]
    return Exposure(
        None if stated[0] is None else Factor(stated[0], source, assumed),
        None if stated[1] is None else Factor(stated[1]),
        f_number,
    )


def file_of(values: np.ndarray, wavelengths_nm: np.ndarray | None = None, **facts: Any) -> Cube:
    """A file with these numbers (H, W, B); more facts by the names of `Cube`'s fields."""
    table = BandTable(wavelengths_nm)
    height, width, bands = values.shape
    return Cube(
        Path("memory.npy"),
        "npy",
        (height, width, bands),
        values.dtype,
        bands=table,
        numbers=Numbers((Held(values),), (height, width, bands), "yxb", values.dtype),
        **facts,
    )


EXIF_CODES = {"ExposureTime": 33434, "FNumber": 33437, "ISOSpeedRatings": 34855, "ISOSpeed": 34867}
FOCAL_PLANE_CODES = {"FocalLength": 37386, "FocalPlaneXResolution": 41486, "FocalPlaneYResolution": 41487}


def xmp_packet(tags: Mapping[str, str | list[str]], as_attributes: bool = False) -> bytes:
    """An XMP packet with tags called `Prefix:Name`."""
    spaces = {tag.split(":")[0] for tag in tags} | {"Camera"}
    declared = " ".join(f'xmlns:{space}="http://example.org/{space}/1.0/"' for space in sorted(spaces))
    attributes, elements = "", ""
    for tag, value in tags.items():
        if isinstance(value, list):
            items = "".join(f"<rdf:li>{item}</rdf:li>" for item in value)
            elements += f"<{tag}><rdf:Seq>{items}</rdf:Seq></{tag}>\n"
        elif as_attributes:
            attributes += f' {tag}="{value}"'
        else:
            elements += f"<{tag}>{value}</{tag}>\n"
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>\n<x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {declared}{attributes}>{elements}</rdf:Description>'
        f"</rdf:RDF></x:xmpmeta>{' ' * 200}<?xpacket end='w'?>"
    ).encode()


def write_band_file(
    path: Path,
    pixels: np.ndarray,
    xmp: Mapping[str, str | list[str]],
    exif: dict[str, float] | None = None,
    *,
    make: str = "Maker",
    black_level: list[int] | None = None,
    orientation: int = 1,
    as_attributes: bool = False,
) -> Path:
    """Write one band; exif by the names of `EXIF_CODES` and `FOCAL_PLANE_CODES`."""
    directory = ImageFileDirectory_v2()
    directory[271], directory[274] = make, orientation
    directory[700] = xmp_packet(xmp, as_attributes)
    if black_level is not None:
        directory.tagtype[50714] = 3
        directory[50714] = tuple(black_level)
    codes = EXIF_CODES | FOCAL_PLANE_CODES
    directory[34665] = {codes[name]: value for name, value in (exif or {}).items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels.astype(np.uint16)).save(path, format="TIFF", tiffinfo=directory)
    return path


def gdal_tag(*entries: str) -> list[tuple[int, str, int, str, bool]]:
    """GDAL's tag of a TIFF, with such entries."""
    return [(42112, "s", 0, f"<GDALMetadata>{''.join(entries)}</GDALMetadata>", True)]


def gdal_items(name: str, values: Any, more: str = "") -> str:
    """Entries of one name, one a band, with more attributes."""
    return "".join(f'<Item name="{name}" sample="{i}"{more}>{value}</Item>' for i, value in enumerate(values))


CODES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12, "u4": 13, "i8": 14, "u8": 15}
AXES = {"bsq": (2, 0, 1), "bil": (0, 2, 1), "bip": (0, 1, 2)}


def write_envi(header: Path, cube: np.ndarray, interleave: str, more: str = "") -> Path:
    """Write a cube (H, W, B) as a header and a file of its name without suffix."""
    header.write_text(header_text(cube, interleave, {}) + more + "\n")
    header.with_suffix("").write_bytes(cube.transpose(AXES[interleave]).tobytes())
    return header


def header_text(cube: np.ndarray, interleave: str, change: Mapping[str, Any]) -> str:
    """Header of a cube; entries in `change` replace others, or take them away."""
    lines, samples, bands = cube.shape
    entries = {
        "samples": samples,
        "lines": lines,
        "bands": bands,
        "data type": CODES[cube.dtype.str[1:]],
        "interleave": interleave,
        "byte order": int(cube.dtype.str[0] == ">"),
        **change,
    }
    return "ENVI\n" + "".join(f"{key} = {value}\n" for key, value in entries.items() if value is not None)


def warnings_of(file: Cube) -> list[str]:
    """What may be wrong with a file, in sentences."""
    return sentences(file.remarks, Kind.WRONG)


def notes_of(file: Cube) -> list[str]:
    """What else is odd about it."""
    return sentences(file.remarks, Kind.DONE)


def check_file(file: Cube, **expected: Any) -> None:
    """That a file is and says what is expected; texts (`evidence`, `warning`, `note`) may be parts of what it says.

    `values` are its numbers, `calibrated` those after its gains and offsets; other names are its fields, those of its
    bands, or what else it says.
    """
    bands = file.bands
    for name, value in expected.items():
        match name:
            case "values":
                np.testing.assert_array_equal(file.read(), value)
            case "calibrated":
                assert file.linear is not None
                np.testing.assert_allclose(file.linear.apply(file.read(), slice(None)), value, atol=2e-6)
            case "nm" | "fwhm":
                found = bands.wavelengths_nm if name == "nm" else bands.fwhm_nm
                assert (found is None) == (value is None), file.remarks
                if found is not None:
                    np.testing.assert_allclose(found, np.broadcast_to(value, found.shape), atol=1e-5)
            case "bad":
                assert bands.bad is not None
                assert np.flatnonzero(bands.bad).tolist() == value
            case "evidence":
                assert value in bands.source
            case "warning" | "note":
                sentences_of = {"warning": warnings_of, "note": notes_of}[name]
                assert any(value in text for text in sentences_of(file)), sentences_of(file)
            case "names":
                assert bands.names == tuple(value)
            case _:
                facts = {"scale": file.linear and file.linear.scale, **file.facts}
                facts |= {"warnings": tuple(warnings_of(file)), "notes": tuple(notes_of(file))}
                found = getattr(file, name) if hasattr(file, name) else facts.get(name)
                assert found == (pytest.approx(value) if isinstance(value, float) else value), name


def rows_and_bands_of(file: Cube, values: np.ndarray) -> None:
    """That a file gives all its numbers, and any rows and bands of them."""
    rows, last = values.shape[0], values.shape[2] - 1
    assert (file.shape, file.dtype.newbyteorder("=")) == (values.shape, values.dtype.newbyteorder("="))
    np.testing.assert_array_equal(file.read(), values)
    assert file.read().dtype == values.dtype.newbyteorder("=")
    for some, bands in ((slice(2, rows - 1), np.array([last, 0, last])), (slice(-2, None), slice(1, 3))):
        np.testing.assert_array_equal(file.read(some, bands), values[some][..., bands])
    np.testing.assert_array_equal(file.read(slice(1, 1)), values[1:1])


def present(value: Any) -> Any:
    """A value that has to be there."""
    assert value is not None
    return value


def matlab73(path, arrays):
    """As MATLAB writes them: axes in reverse order, behind 512 bytes of its own."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in arrays.items():
            file[name] = np.asarray(array).T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def hdf5(path, arrays, **attributes):
    """Data sets in chunks, all with the same attributes."""
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, chunks=True, compression="gzip").attrs.update(attributes)


def netcdf3(path, arrays):
    with scipy.io.netcdf_file(path, "w") as file:
        for name, array in arrays.items():
            names = tuple(f"{name}_{axis}" for axis in range(array.ndim))
            for dimension, length in zip(names, array.shape, strict=True):
                file.createDimension(dimension, length)
            file.createVariable(name, array.dtype.newbyteorder("="), names)[:] = array


ARRAY_WRITERS: dict[str, Callable[..., object]] = {
    "v5.mat": scipy.io.savemat,
    "compressed.mat": partial(scipy.io.savemat, do_compression=True),
    "v73.mat": matlab73,
    "cube.h5": hdf5,
    "scaled.h5": partial(hdf5, scale_factor=0.01),
    "cube.nc": netcdf3,
    "cube.npz": lambda path, arrays: np.savez(path, **arrays),
    "small.npz": lambda path, arrays: np.savez_compressed(path, **arrays),
}
"""By the name of a file: writes arrays by name."""
