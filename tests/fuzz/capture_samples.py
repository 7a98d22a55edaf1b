"""Small files of every kind that instruments write: what damage starts from."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import h5py
import numpy as np
import OpenEXR
import scipy.io
import tifffile
import torch
from PIL import Image

from tests.captures.file_factory import header_text, write_band_file
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.formats.files import array_bytes

CUBE = np.random.default_rng(0).integers(0, 200, (5, 4, 3)).astype(np.uint16)
NM = np.array([450.0, 550.0, 650.0])
_LARGEST = 2**24


def read_capture(path: Path) -> None:
    """Open a file and read it, or its last row where it says that it is large."""
    file = open_spectral_file(path)
    height, width, num_bands = file.shape
    if height * width * num_bands < _LARGEST:
        assert file.read().shape == file.shape
    elif width * num_bands < _LARGEST:
        file.read(slice(height - 1, height))
    for values in (file.bands.wavelengths_nm, file.bands.fwhm_nm, file.bands.bad):
        assert values is None or np.isfinite(values).all()


def _tiff(**options: Any) -> bytes:
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, CUBE, photometric="minisblack", planarconfig="contig", **options)
    return buffer.getvalue()


def _tiff_pages() -> bytes:
    buffer = io.BytesIO()
    with tifffile.TiffWriter(buffer) as file:
        for nm, plane in zip(NM, CUBE.transpose(2, 0, 1), strict=True):
            file.write(plane, description=f"{nm} nm", metadata=None)
    return buffer.getvalue()


def _gdal() -> bytes:
    items = "".join(f'<Item name="wavelength" sample="{i}">{nm}</Item>' for i, nm in enumerate(NM))
    return _tiff(extratags=[(42112, "s", 0, f"<GDALMetadata>{items}</GDALMetadata>", True)], metadata=None)


def _on_disk(name: str, write: Callable[[Path], object]) -> bytes:
    with TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def _exr(path: Path) -> None:
    channels = {
        f"S0.{nm:.1f}nm".replace(".", ",").replace(",", ".", 1): CUBE[..., i] for i, nm in enumerate(NM)
    }
    planes = {name: np.ascontiguousarray(plane, dtype=np.float32) for name, plane in channels.items()}
    OpenEXR.File({"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}, planes).write(
        str(path)
    )


def _hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["cube"], file["wavelengths"] = CUBE, NM
        file["cube"].attrs["scale_factor"] = 0.01


def _netcdf(path: Path) -> None:
    with scipy.io.netcdf_file(path, "w") as file:
        for name, length in (("y", 5), ("x", 4), ("band", 3)):
            file.createDimension(name, length)
        file.createVariable("cube", np.dtype("i2"), ("y", "x", "band"))[:] = CUBE
        file.createVariable("wavelength", np.dtype("f8"), ("band",))[:] = NM


def _npz() -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, cube=CUBE, wavelengths=NM)
    return buffer.getvalue()


def _torch(**options: bool) -> bytes:
    buffer = io.BytesIO()
    torch.save(torch.tensor(CUBE.astype(np.uint8)), buffer, **options)
    return buffer.getvalue()


def _picture(kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(CUBE.astype(np.uint8)).save(buffer, format=kind)
    return buffer.getvalue()


def _envi() -> bytes:
    more = "wavelength units = nm\nwavelength = {450, 550,\n650}\nfwhm = {5, 5, 5}\nbbl = {1, 0, 1}\n"
    more += "data ignore value = 0\nreflectance scale factor = 100\nband names = {a (1 nm), b, c}\n; end\n"
    return (header_text(CUBE, "bil", {}) + more).encode()


def _matlab(path: Path, **options: Any) -> None:
    scipy.io.savemat(path, {"cube": CUBE, "wavelengths": NM, "name": "x"}, **options)


def _of_rig() -> bytes:
    tags: dict[str, Any] = {"BandName": "Red", "CentralWavelength": "660", "WavelengthFWHM": "40"}
    tags = {f"Camera:{name}": value for name, value in tags.items()}
    more = {"Camera:SensorModel": "4.1e5,2000.0,100.0", "Camera:VignettingPolynomial": ["0.55", "1.5"]}
    exif = {"FNumber": 2.2, "ISOSpeedRatings": 100, "FocalPlaneXResolution": 20.0}
    return _on_disk("a.tif", lambda path: write_band_file(path, CUBE[..., 0], tags | more, exif))


def xml_beside() -> tuple[bytes, ...]:
    """What GDAL and EnMAP's processor put beside an image."""
    gdal = "".join(
        f'<PAMRasterBand band="{i}"><NoDataValue>0</NoDataValue><Offset>0.5</Offset><Scale>0.01</Scale></PAMRasterBand>'
        for i in (1, 2, 3)
    )
    enmap = "".join(
        f'<bandID number="{i}"><wavelengthCenterOfBand>{nm}</wavelengthCenterOfBand><FWHMOfBand>6</FWHMOfBand>'
        f"<GainOfBand>0.01</GainOfBand><OffsetOfBand>0</OffsetOfBand></bandID>"
        for i, nm in enumerate(NM, 1)
    )
    enmap = f"<level_X><bandCharacterisation>{enmap}</bandCharacterisation></level_X>"
    return (f"<PAMDataset>{gdal}</PAMDataset>".encode(), enmap.encode())


def read_with_xml(path: Path) -> None:
    """Read an image by what lies beside it."""
    read_capture(path.with_name("cube.tif"))


ENVI_DATA = CUBE.transpose(0, 2, 1).tobytes()
SAMPLES: dict[str, Callable[[], tuple[bytes, ...]]] = {
    "cube.hdr": lambda: (_envi(),),
    "cube.tif": lambda: (
        _tiff(),
        _tiff(compression="zlib", rowsperstrip=2),
        _tiff_pages(),
        _gdal(),
        _of_rig(),
    ),
    "cube.exr": lambda: (_on_disk("a.exr", _exr),),
    "cube.mat": lambda: tuple(
        _on_disk("a.mat", partial(_matlab, do_compression=packed)) for packed in (False, True)
    ),
    "cube.h5": lambda: (_on_disk("a.h5", _hdf5),),
    "cube.nc": lambda: (_on_disk("a.nc", _netcdf),),
    "cube.npy": lambda: tuple(array_bytes(cube) for cube in (CUBE, CUBE.astype(">f4"), CUBE[..., 0])),
    "cube.npz": lambda: (_npz(),),
    "cube.pt": lambda: (_torch(), _torch(_use_new_zipfile_serialization=False)),
    "cube.png": lambda: (_picture("PNG"), _picture("JPEG")),
}
"""By the name of the file."""
