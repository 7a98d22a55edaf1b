"""Exposure under its many names, and what becomes of it."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from tests.factories.captures import (
    BANDS,
    HEIGHT,
    WIDTH,
    make_capture,
    process,
    write_cube,
    write_poses,
)
from tests.factories.files import exposure_of_file, file_of, present
from unmix_plugin.captures.cube import Exposure, Linear, Meaning
from unmix_plugin.captures.decide import ExposedFiles, compare_exposures
from unmix_plugin.captures.fields import state_exposure
from unmix_plugin.captures.report import Code, Kind, Remark, sentences


@pytest.mark.parametrize(
    ("entries", "seconds"),
    [
        ({"tint": "10.5"}, 0.0105),
        ({"integration time": "8000 us"}, 0.008),
        ({"Integration_Time (us)": "8000"}, 0.008),
        ({"camera exposure time [s]": "0.02"}, 0.02),
        ({"exposure_ms": 4}, 0.004),
        ({"Exposure (uS)": 4000}, 0.004),
        ({"exposureTimeMs": 4}, 0.004),
        ({"ExposureTime": "2.5 msec"}, 0.0025),
        ({"expTime": 0.5}, 0.5),
        ({"shutter": "1/50 s"}, 0.02),
        ({"integration time": "{5, 5, 5}"}, 0.005),
        ({"exposure time": "500 \u00b5s"}, 0.0005),
        ({"integration time": "500", "integration time units": "us"}, 0.0005),
    ],
)
def test_times_by_any_name_in_any_unit(entries, seconds):
    remarks: list[Remark] = []
    assert state_exposure(entries, "header field", remarks).to_json()["exposure_s"] == pytest.approx(seconds)
    assert not remarks


@pytest.mark.parametrize(
    ("name", "text"), [("exposure", "-1.5 EV"), ("exposure", "1" * 100_000 + "!"), ("gain", "99999 dB")]
)
def test_what_is_not_understood_is_said(name, text):
    remarks: list[Remark] = []
    assert state_exposure({name: text}, "header field", remarks) == Exposure()
    assert f"header field '{name}' is '{text[:60]}', which is not understood" in remarks[0].sentence


@pytest.mark.parametrize("faulty", ["f/2.8", (28, 10), float("inf"), 0.0, -1.0, None])
def test_a_faulty_tag_of_exif_leaves_the_others_of_an_exposure(faulty):
    def facts(time, speed, f_number):
        entries = {"EXIF ExposureTime": time, "EXIF ISOSpeedRatings": speed, "EXIF FNumber": f_number}
        found = state_exposure(entries, "tag", []).to_json()
        return [found.get(name) for name in ("exposure_s", "gain", "f_number")]

    assert facts(0.02, 200, faulty) == [0.02, 2.0, None]
    assert facts(0.02, faulty, 2.8) == [0.02, None, 2.8]
    assert faulty == (28, 10) or facts(faulty, 200, 2.8) == [None, None, None]


@pytest.mark.parametrize(
    ("entries", "gain"),
    [
        ({"gain": "6.0206 dB"}, 2.0),
        ({"gain (dB)": "6.0206"}, 2.0),
        ({"Gain_dB": 6.0206}, 2.0),
        ({"GainDB": 6.0206}, 2.0),
        ({"camera gain": "4"}, 4.0),
        ({"analog gain": "2", "digital gain": "4"}, 8.0),
        ({"digital gain": "4", "analog gain": "2"}, 8.0),
        ({"analog gain": "6.0206 dB", "digital gain": "{1, 2, 3}"}, [2.0, 4.0, 6.0]),
        ({"digital gain": "4", "gain": "2", "analog gain": "8"}, 2.0),  # the whole
        ({"analogue gain": "2"}, 2.0),
        ({"analog gain": "{1, 2}", "digital gain": "{1, 2, 3}"}, None),
    ],
)
def test_gains_of_parts_of_a_camera_multiply_each_other_and_a_plain_one_is_the_whole(entries, gain):
    remarks: list[Remark] = []
    facts = state_exposure(entries, "header field", remarks).to_json()
    assert facts.get("gain") == (pytest.approx(gain, rel=1e-4) if gain else None)
    assert len(remarks) == (gain is None)


def exposed(time, gain=1.0, source="header field 'tint'", assumed="milliseconds"):
    exposure = exposure_of_file(time, gain, source=source, assumed=assumed)
    return file_of(np.ones((2, 2, 3), np.uint16), exposure=exposure)


@dataclass(frozen=True)
class Compared:
    """What they are brought to, with notes and warnings."""

    common: np.ndarray | None
    remarks: tuple[Remark, ...]

    @property
    def codes(self) -> set[Code]:
        return {remark.code for remark in self.remarks}

    @property
    def notes(self) -> list[str]:
        return sentences(self.remarks, Kind.DONE)

    @property
    def warnings(self) -> list[str]:
        return sentences(self.remarks, Kind.WRONG)


def compared(views, whites=(), darks=(), is_bent=False, may_be_finished=False) -> Compared:
    found = compare_exposures(ExposedFiles(views, whites, darks, is_bent, may_be_finished))
    return Compared(found.common, found.remarks)


def test_views_are_brought_to_the_white_and_that_is_said():
    found = compared([exposed(0.01), exposed(0.02, 2.0)], [exposed(0.005)])
    np.testing.assert_array_equal(found.common, [0.005])
    said = "exposed 0.01 to 0.04 s times gain: each is brought to that of the white reference, 0.005"
    assert found.notes == [f"views were {said}"]
    assert found.warnings == []
    same = compared([exposed(0.01)] * 2, [exposed(0.01)], [(exposed(0.01), exposed(0.01))])
    assert (same.notes, same.warnings) == ([], [])
    bands = exposed([0.01, 0.02, 0.04])  # which may differ within a view
    np.testing.assert_array_equal(bands.total_exposure(), [0.01, 0.02, 0.04])
    np.testing.assert_array_equal(compared([bands]).common, [0.02])


def test_what_may_be_wrong_with_exposures_is_said():
    def warnings(*files, **options):
        return " ".join(compared(*files, **options).warnings)

    plain = file_of(np.ones((2, 2, 3), np.uint16))
    views = [exposed(0.01), exposed(0.02)]
    assert "dark frame was exposed 0.02" in warnings(views, [], [(exposed(0.02), view) for view in views])
    assert warnings(views, [], [(view, view) for view in views]) == ""  # each view has one of its own
    assert "1 view without exposure time" in warnings([*views, plain], [], [])
    assert "does not say how long" in warnings(views, [plain], [])
    assert "cameras encode the brightness" in warnings(views, [], [], is_bent=True)
    other = exposed(0.005, source="header field 'exposure time'", assumed="")
    assert "have no unit in some files" in warnings(views, [other], [])
    assert warnings([exposed(0.01), replace(exposed([0.01, 0.02]), shape=(2, 2, 2))]) == ""  # of two sizes


def test_the_aperture_counts_for_light_and_not_for_dark_current():
    def taken(time, f_number):
        return replace(exposed(time), exposure=exposure_of_file(time, None, f_number))

    views = [taken(0.01, 4.0), taken(0.02, 4.0 * 2**0.5), taken(0.04, 8.0)]  # the same light
    found = compared(views)
    np.testing.assert_allclose([present(view.total_exposure()) for view in views], 0.01 / 16)
    np.testing.assert_allclose(present(found.common), 0.01 / 16)
    brighter = compared([*views, taken(0.01, 2.0)], [], [(taken(0.01, 16.0), views[0])])
    assert " s over the square of the f-number: each is brought to" in brighter.notes[0]
    assert brighter.warnings == []
    (warning,) = compared(views[:1], [], [(taken(0.04, 8.0), views[0])]).warnings
    assert "dark frame was exposed 0.04" in warning
    (warning,) = compared([*views, exposed(0.01)]).warnings
    assert "the f-number of the lens is known of some files and not of memory.npy: exposures are" in warning
    assert compared(views, [exposed(0.01)]).common is None


def test_scenes_have_the_same_values_whatever_the_exposures(tmp_path):
    made = make_capture(tmp_path / "capture")
    name = "view_01"
    counts = made.reflectance[name] * made.white * 3 + made.dark
    write_cube(tmp_path / "capture", name, np.rint(counts).astype(np.uint16), header={"tint": "30"})
    for other in ("view_00", "view_02", "view_03", "white", "dark"):
        with (tmp_path / "capture" / f"{other}.hdr").open("a") as header:
            header.write("exposure time (us) = 10000\n")
    references = {key: tmp_path / "capture" / f"{key}.hdr" for key in ("white", "dark")}
    wrong = process(tmp_path / "capture", tmp_path / "scene", **references)
    assert any("the dark frame was exposed 0.01" in text for text in wrong)
    assert any("have no unit in some files" in text for text in wrong)
    for view in made.reflectance:
        stored = np.load(tmp_path / "scene" / "cubes" / f"{view}.npy") / 65535
        np.testing.assert_allclose(stored, made.reflectance[view], atol=1e-3)


@pytest.mark.parametrize("stated", ["{10.5, 5.25}", "10,5"])
def test_exposures_that_are_neither_one_nor_one_a_band_are_not_dropped_in_silence(stated):
    exposure = state_exposure({"tint": stated}, "header field", [])
    odd = file_of(np.ones((2, 2, 3), np.uint16), exposure=exposure)
    other = exposed([0.02, 0.01])
    for views, whites in (([odd, other], []), ([odd], [exposed(0.01)]), ([exposed(0.01)], [odd])):
        found = compared(views, whites)
        assert "2 exposure times or gains for 3 bands: exposures may differ" in " ".join(found.warnings)
        assert not found.notes
    assert compared([odd, odd], [odd]).warnings == []  # nothing that could differ


@pytest.mark.parametrize(("factor", "is_stated"), [(10000, True), (1, True), (1, False)])
def test_reflectances_are_not_divided_by_the_exposure_of_their_raw_files(tmp_path, factor, is_stated):
    """SPy writes the header of the raw file, with its tint, beside what was made of it."""
    header = {"reflectance scale factor": f"{factor}"} if is_stated else {}
    values = np.random.default_rng(0).uniform(0.1, 0.9, (HEIGHT, WIDTH, BANDS)) * factor
    (tmp_path / "capture").mkdir()
    names = [f"view_{index:02d}" for index in range(4)]
    for index, name in enumerate(names):
        stored = values.astype(np.float32 if factor == 1 else np.uint16)
        write_cube(tmp_path / "capture", name, stored, header={"tint": f"{10 + 10 * (index % 2)}", **header})
    write_poses(tmp_path / "capture" / "transforms.json", names)
    told: list[str] = []
    wrong = process(tmp_path / "capture", tmp_path / "scene", "cubes", told.append)
    means = [np.load(tmp_path / "scene" / "cubes" / f"{name}.npy").mean() / 65535 for name in names]
    np.testing.assert_allclose(means, values.mean() / factor, rtol=1e-3)
    said = next(text for text in (told if header else wrong[:1]) if "values are not divided by that" in text)
    assert "were exposed 0.01 to 0.02 s: " in said
    # Which nobody can know: the report begins with it.
    assert ("taken for reflectances" in said) == (not header)


def test_values_that_may_be_reflectances_are_raw_beside_a_reference():
    views = [exposed(0.01), exposed(0.02)]
    (warning,) = compared(views, may_be_finished=True).warnings
    assert "give a white reference, or divide them by it yourself" in warning
    assert compared(views, [exposed(0.01)], may_be_finished=True).common == 0.01
    darks = [(exposed(0.01), views[0])]
    assert compared(views, [], darks, may_be_finished=True).common == 0.01


def test_values_are_finished_by_gains_or_names_that_say_so():
    """REFLECTANCE_212 is what a Specim IQ writes."""

    def notes(whites=(), **facts):
        files = [replace(exposed(time), **facts) for time in (0.01, 0.02)]
        return compared(files, whites).notes

    values = np.dtype(np.float32)
    linear = Linear(np.full(3, 0.5), np.zeros(3), "attribute 'scale_factor'")
    for path in (Path("results/REFLECTANCE_212.dat"), Path("leaf-reflectance.npy")):
        assert "not divided by that" in notes(path=path, dtype=values)[0]
        assert "not divided by that" in notes(path=path, linear=linear)[0]
        assert "each is brought to" in notes(path=path)[0]  # raw, as whole numbers are
        assert "each is brought to" in notes([exposed(0.01)], path=path, dtype=values)[0]
    for meaning in (Meaning.RADIANCE, Meaning.REFLECTANCE):
        assert "not divided by that" in notes(linear=replace(linear, meaning=meaning))[0]
    assert "each is brought to" in notes(linear=linear)[0]
    assert "each is brought to" in notes(path=Path("reflectances_of_lamps.npy"), dtype=values)[0]


def stating(time=0.01, **factors):
    return file_of(np.ones((2, 2, 3), np.uint16), exposure=exposure_of_file(time, **factors))


@pytest.mark.parametrize(
    ("views", "whites", "code", "is_compared"),
    [
        ([{"gain": 4.0}], [{}], Code.EXPOSURE_FACTOR_UNKNOWN, False),
        ([{}], [{"gain": 4.0}], Code.EXPOSURE_FACTOR_UNKNOWN, False),
        ([{"gain": 4.0}, {}], [], Code.EXPOSURE_FACTOR_UNKNOWN, False),
        ([{"gain": [1.0, 2.0, 1.0]}, {}], [], Code.EXPOSURE_FACTOR_UNKNOWN, False),
        ([{"f_number": 4.0}], [{}], Code.EXPOSURE_FACTOR_UNKNOWN, False),
        ([{"gain": 1.0}], [{}], Code.GAIN_TAKEN_AS_ONE, True),
        ([{}], [{"time": None}], Code.WHITE_EXPOSURE_UNKNOWN, True),
        ([{"time": None}], [{}], Code.EXPOSURE_UNKNOWN, False),
        ([{"time": None}, {}], [], Code.EXPOSURE_UNKNOWN, False),
    ],
)
def test_what_one_file_states_and_another_lacks_is_not_taken_for_one_in_silence(
    views, whites, code, is_compared
):
    found = compared([stating(**facts) for facts in views], [stating(**facts) for facts in whites])
    assert found.codes == {code}
    assert code.looks_wrong
    assert (found.common is not None) == is_compared


def test_values_are_not_divided_by_a_gain_that_the_white_lacks(tmp_path):
    made = make_capture(tmp_path / "capture")
    for name in ("view_00", "view_01", "view_02", "view_03", "white", "dark"):
        with (tmp_path / "capture" / f"{name}.hdr").open("a") as header:
            header.write("exposure time (us) = 10000\n" + ("" if name == "white" else "gain = 4\n"))
    references = {key: tmp_path / "capture" / f"{key}.hdr" for key in ("white", "dark")}
    wrong = process(tmp_path / "capture", tmp_path / "scene", **references)
    assert any("the gain is known of some files and not of white.hdr" in text for text in wrong)
    for view in made.reflectance:
        stored = np.load(tmp_path / "scene" / "cubes" / f"{view}.npy") / 65535
        np.testing.assert_allclose(stored, made.reflectance[view], atol=1e-3)


def test_a_scale_that_files_of_another_size_lack_is_not_taken_for_one_in_silence(tmp_path):
    made = make_capture(tmp_path / "capture", views=6)
    for index, (name, values) in enumerate(made.reflectance.items()):
        header = {"reflectance scale factor": "10000"} if index < 4 else {}
        values = np.rint(values * 10000).astype(np.uint16)
        write_cube(tmp_path / "capture", name, values[: HEIGHT - 8 * (index >= 4)], header=header)
    written = json.loads((tmp_path / "capture" / "transforms.json").read_text())
    for frame in written["frames"][4:]:
        frame["h"] = HEIGHT - 8
    (tmp_path / "capture" / "transforms.json").write_text(json.dumps(written))
    wrong = process(tmp_path / "capture", tmp_path / "scene")
    assert any("values of lenses or cameras are not of one kind" in text for text in wrong)
