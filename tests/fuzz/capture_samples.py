"""Small files of every kind that instruments write: what damage starts from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tifffile
from PIL import Image

from tests.factories.data_sets import write_exr
from tests.factories.files import ARRAY_WRITERS, gdal_items, gdal_tag, header_text, write_band_file
from unmix_plugin.captures.readers.opening import open_spectral_file
from unmix_plugin.formats.files import array_bytes

CUBE = np.random.default_rng(0).integers(0, 200, (5, 4, 3)).astype(np.int16)
NM = np.array([450.0, 550.0, 650.0])
_LARGEST = 2**24
_OF_RIG = {
    "Camera:BandName": "Red",
    "Camera:CentralWavelength": "660",
    "Camera:WavelengthFWHM": "40",
    "Camera:SensorModel": "4.1e5,2000.0,100.0",
    "Camera:VignettingPolynomial": ["0.55", "1.5"],
}
_EXIF = {"FNumber": 2.2, "ISOSpeedRatings": 100, "FocalPlaneXResolution": 20.0}
_HEADER = """wavelength units = nm
wavelength = {450, 550,
650}
fwhm = {5, 5, 5}
bbl = {1, 0, 1}
data ignore value = 0
reflectance scale factor = 100
band names = {a (1 nm), b, c}
; end
"""


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


def read_with_xml(path: Path) -> None:
    """Read an image by what lies beside it."""
    read_capture(path.with_name("cube.tif"))


def _written(write: Callable[..., object], *arguments: Any, suffix: str = "", **options: Any) -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        write(path, *arguments, **options)
        return path.read_bytes()


def _tiff(**options: Any) -> bytes:
    return _written(tifffile.imwrite, CUBE, photometric="minisblack", planarconfig="contig", **options)


def _tiff_pages() -> bytes:
    def write(path: Path) -> None:
        with tifffile.TiffWriter(path) as file:
            for nm, plane in zip(NM, CUBE.transpose(2, 0, 1), strict=True):
                file.write(plane, description=f"{nm} nm", metadata=None)

    return _written(write)


def _gdal() -> bytes:
    return _tiff(extratags=gdal_tag(gdal_items("wavelength", NM)), metadata=None)


def _exr() -> bytes:
    return _written(write_exr, {f"S0.{nm:.0f},0nm": CUBE[..., i] for i, nm in enumerate(NM)})


def _arrays(*kinds: str) -> tuple[bytes, ...]:
    arrays = {"cube": CUBE, "wavelengths": NM}
    return tuple(_written(ARRAY_WRITERS[kind], arrays, suffix=Path(kind).suffix) for kind in kinds)


def _pictures() -> tuple[bytes, ...]:
    picture = Image.fromarray(CUBE.astype(np.uint8))
    return _written(picture.save, suffix=".png"), _written(picture.save, suffix=".jpg")


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


ENVI_DATA = CUBE.transpose(0, 2, 1).tobytes()
SAMPLES: dict[str, Callable[[], tuple[bytes, ...]]] = {
    "cube.hdr": lambda: ((header_text(CUBE, "bil", {}) + _HEADER).encode(),),
    "cube.tif": lambda: (
        _tiff(),
        _tiff(compression="zlib", rowsperstrip=2),
        _tiff_pages(),
        _gdal(),
        _written(write_band_file, CUBE[..., 0], _OF_RIG, _EXIF),
    ),
    "cube.exr": lambda: (_exr(),),
    "cube.mat": lambda: _arrays("v5.mat", "compressed.mat"),
    "cube.h5": lambda: _arrays("scaled.h5"),
    "cube.nc": lambda: _arrays("cube.nc"),
    "cube.npy": lambda: tuple(array_bytes(cube) for cube in (CUBE, CUBE.astype(">f4"), CUBE[..., 0])),
    "cube.npz": lambda: _arrays("small.npz"),
    "cube.png": _pictures,
}
"""By the name of the file."""
