"""What holds for every reader, and `unmix-process inspect`."""

import json
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
import tifffile

from tests.captures.file_factory import header_text, write_envi
from unmix_plugin.captures.readers.opening import inspect_file, open_spectral_file
from unmix_plugin.captures.spectral_file import BandTable, ReadOptions, SpectralFile, stack_bands
from unmix_plugin.commands.process import process
from unmix_plugin.commands.process_inspect import inspect_command
from unmix_plugin.errors import CaptureError, ConfigError

PLAIN = np.arange(60, dtype=np.uint16).reshape(3, 4, 5)


@pytest.mark.parametrize("package", ["tifffile", "h5py"])
def test_a_package_that_is_not_installed_is_named_with_its_extra(tmp_path, monkeypatch, package):
    tifffile.imwrite(tmp_path / "tifffile", PLAIN[0])
    with h5py.File(tmp_path / "h5py", "w") as file:
        file["cube"] = PLAIN
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(CaptureError, match=rf"the package {package}, .*pip install 'unmix-nerf\[captures\]'"):
        open_spectral_file(tmp_path / package)


def test_names_that_are_no_text_are_read(tmp_path):
    path = tmp_path / b"cube-\xff.npy".decode("utf-8", "surrogateescape")
    np.save(path, PLAIN)
    np.testing.assert_array_equal(open_spectral_file(path).read(), PLAIN)


def part(tmp_path, value, **metadata):
    values = np.full((2, 3, 1), value)
    table = BandTable(np.array([400.0 + value]), "test")
    return SpectralFile(
        tmp_path / str(value),
        "npy",
        (2, 3, 1),
        values.dtype,
        lambda rows, bands: values[rows][..., bands],
        table,
        metadata=metadata,
        scale=metadata.get("scale"),
    )


def test_a_stack_keeps_what_its_parts_share_and_lists_the_rest(tmp_path):
    parts = [
        part(tmp_path, 1, camera="a", exposure_s=0.1, scale=2.0),
        part(tmp_path, 2, camera="a", exposure_s=0.2),
    ]
    stack = stack_bands(parts, tmp_path)
    assert stack.metadata == {
        "camera": "a",
        "parts": [{"exposure_s": 0.1, "scale": 2.0}, {"exposure_s": 0.2}],
    }
    assert stack.scale is None
    np.testing.assert_array_equal(stack.read(slice(1, 2), np.array([1, 0]))[0, 0], [2, 1])
    alike = stack_bands([part(tmp_path, 1, scale=3.0), part(tmp_path, 2, scale=3.0)], tmp_path)
    assert (alike.bands.evidence, stack.bands.evidence) == ("test", "test")
    unknown = replace(part(tmp_path, 3), bands=BandTable())
    mixed = stack_bands([*parts, unknown], tmp_path).bands
    assert (mixed.wavelengths_nm, mixed.evidence) == (None, "only some of the files give wavelengths")
    assert (alike.scale, alike.metadata) == (3.0, {"scale": 3.0})


def test_what_a_library_raises_while_reading_is_an_error_of_the_file(tmp_path):
    def file_that_raises(error):
        def read_part(*_):
            raise error

        return SpectralFile(tmp_path / "a", "npy", (2, 3, 1), np.dtype("u1"), read_part)

    with pytest.raises(CaptureError, match=r"a: can't be read \(RuntimeError: no luck at all\)"):
        file_that_raises(RuntimeError("no luck\nat all")).read()
    with pytest.raises(CaptureError, match="a: too little memory"):
        file_that_raises(MemoryError()).read()


CUBE = np.random.default_rng(0).integers(0, 9000, (4, 6, 3)).astype("<u2")
BANDS = "wavelength units = nm\nwavelength = {450, 550, 650.5}\nfwhm = {5, 5, 6}\nbbl = {1, 0, 1}\nsensor type = X"

FACTS = {
    *("file", "reader", "shape", "dtype", "interleave", "wavelengths_nm", "wavelength_evidence", "fwhm_nm"),
    *("band_names", "bad_bands", "scale", "no_data", "poses", "notes", "metadata"),
}


@pytest.fixture
def header(tmp_path):
    return write_envi(tmp_path / "cube.hdr", CUBE, "bil", BANDS + "\ndata ignore value = nan")


@pytest.fixture
def poses(tmp_path):
    placed = [np.eye(4) + np.eye(4, k=3) * distance for distance in range(3)]
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose.tolist()} for i, pose in enumerate(placed)]
    (tmp_path / "transforms.json").write_text(
        json.dumps({"camera_angle_x": 0.7, "w": 6, "h": 4, "frames": frames})
    )
    return tmp_path / "transforms.json"


def test_facts_of_an_image(header):
    facts = inspect_file(header)
    assert set(facts) == FACTS
    expected = {
        "file": str(header),
        "reader": "envi",
        "shape": [4, 6, 3],
        "dtype": "uint16",
        "interleave": "bil",
        "wavelengths_nm": [450, 550, 650.5],
        "wavelength_evidence": "header field 'wavelength', nm",
        "fwhm_nm": [5, 5, 6],
        "bad_bands": [1],
        "scale": None,
        "no_data": "nan",
        "poses": None,
    }
    assert {key: facts[key] for key in expected} == expected
    assert facts["metadata"]["header"]["sensor type"] == "X"


def test_facts_of_poses(poses):
    facts = inspect_file(poses)
    assert set(facts) == FACTS
    assert (facts["poses"], facts["shape"]) == (3, None)


def test_poses_in_an_array(tmp_path):
    rows = np.zeros((5, 17))
    for distance, row in enumerate(rows):
        row[:15] = np.hstack([np.eye(3), [[distance], [0], [0]], [[480], [640], [500]]]).reshape(-1)
        row[15:] = 1, 9
    np.save(tmp_path / "poses_bounds.npy", rows)
    assert inspect_file(tmp_path / "poses_bounds.npy")["poses"] == 5


def test_numbers_that_are_not_there_are_found_out(tmp_path):
    header = tmp_path / "cube.hdr"
    header.write_text(header_text(CUBE, "bsq", {}))
    with pytest.raises(CaptureError, match="no file of numbers"):
        inspect_file(header)
    np.savez_compressed(tmp_path / "a.npz", cube=CUBE)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[len(data) // 2] ^= 255
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(CaptureError, match=r"a\.npz"):
        inspect_file(tmp_path / "a.npz")


def test_a_list_of_pixels_needs_its_size(tmp_path):
    np.savez(tmp_path / "a.npz", Y=CUBE.reshape(-1, 3))
    assert inspect_file(tmp_path / "a.npz", ReadOptions(dataset="Y", size=(4, 6)))["shape"] == [4, 6, 3]


def test_one_json_object_a_file_and_status_2_if_one_is_refused(header, poses, tmp_path, capsys):
    assert inspect_command([str(header), str(poses), "--json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [json.loads(line)["file"] for line in lines] == [str(header), str(poses)]
    assert inspect_command(["--json", str(tmp_path / "missing.hdr"), str(header)]) == 2
    refused, good = map(json.loads, capsys.readouterr().out.splitlines())
    assert refused == {
        "file": str(tmp_path / "missing.hdr"),
        "error": f"{tmp_path / 'missing.hdr'}: no such file",
    }
    assert good["reader"] == "envi"


def test_the_command_of_captures_passes_it_on(header, tmp_path, capsys):
    process(["inspect", "--json", str(header)])
    assert json.loads(capsys.readouterr().out)["shape"] == [4, 6, 3]
    with pytest.raises(SystemExit) as left:
        process(["inspect", "--json", str(tmp_path / "missing.hdr")])
    assert left.value.code == 2


def test_options_reach_the_reader(tmp_path, capsys):
    np.savez(tmp_path / "a.npz", first=CUBE, second=CUBE[:2])
    assert inspect_command(["--json", str(tmp_path / "a.npz"), "--dataset", "second", "--axes", "bxy"]) == 0
    assert json.loads(capsys.readouterr().out)["shape"] == [3, 6, 2]


def test_the_table_for_people(header, poses, tmp_path, capsys):
    (tmp_path / "a.raw").write_bytes(b"nothing known")
    assert inspect_command([str(header), str(poses), str(tmp_path / "a.raw")]) == 2
    out = " ".join(capsys.readouterr().out.split())
    assert "4 rows x 6 columns x 3 bands, uint16, bil, read as envi" in out
    assert "450 to 650.5 nm, FWHM 5 to 6 nm (header field 'wavelength', nm)" in out
    assert "bad bands 1" in out
    assert "3 cameras" in out
    assert "of no known kind" in out


def test_no_file_is_an_error():
    with pytest.raises(ConfigError, match="no file is named"):
        inspect_command([])
