"""A file of an instrument: reading parts of it, and stacks of several."""

from dataclasses import replace

import numpy as np
import pytest

from tests.factories.files import exposure_of_file, file_of, present, warnings_of
from unmix_plugin.captures.cube import BandTable, Cube, linear_values
from unmix_plugin.captures.numbers import Held, Numbers
from unmix_plugin.captures.readers.band_files import stack_bands
from unmix_plugin.errors import CaptureError


def part(tmp_path, value, time=None, gain=None, f_number=None, scale=None, **others):
    exposure = exposure_of_file(time, gain, f_number)
    return replace(
        file_of(np.full((2, 3, 1), value), np.array([400.0 + value]), exposure=exposure, others=others),
        path=tmp_path / str(value),
        bands=BandTable(np.array([400.0 + value]), "test"),
        linear=linear_values(tmp_path, 1, gains=[1 / scale], source="test") if scale else None,
    )


def test_a_stack_keeps_what_its_parts_share_and_lists_the_rest(tmp_path):
    parts = [part(tmp_path, 1, camera="a", time=0.1, slot=1, scale=2.0)]
    parts.append(part(tmp_path, 2, camera="a", time=0.2))
    stack = stack_bands(parts, tmp_path)
    each = [{"exposure_s": 0.1, "slot": 1}, {"exposure_s": 0.2}]
    assert stack.facts == {"camera": "a", "exposure_s": [0.1, 0.2], "parts": each}
    assert (stack.bands.source, present(stack.linear).scale) == ("test", None)
    np.testing.assert_array_equal(stack.read(slice(1, 2), np.array([1, 0]))[0, 0], [2, 1])
    alike = stack_bands([part(tmp_path, 1, scale=3.0), part(tmp_path, 2, scale=3.0)], tmp_path)
    assert (present(alike.linear).scale, alike.facts, warnings_of(alike)) == (3.0, {}, [])
    assert "only some of the files of one view state gains" in warnings_of(stack)[0]
    mixed = stack_bands([*parts, replace(part(tmp_path, 3), bands=BandTable())], tmp_path).bands
    assert (mixed.wavelengths_nm, mixed.source) == (None, "only some of the files give wavelengths")


@pytest.mark.parametrize(
    ("first_gain", "second", "exposures", "said"),
    [
        (1.0, {"time": 0.1, "gain": 1.0}, 0.1, None),
        (1.0, {"time": 0.1, "gain": 4.0}, [0.1, 0.4], None),  # though the times are equal
        (1.0, {"time": 0.2}, [0.1, 0.2], "where it is taken for 1, too: values may be off"),
        (4.0, {"time": 0.2}, None, "the gain is known of some bands and not of 2"),
        (
            1.0,
            {"time": 0.1, "gain": [1.0, 4.0]},
            None,
            "exposure time and gain is not known of every band",
        ),
        (1.0, {}, None, "exposure time and gain is not known of every band"),
    ],
)
def test_a_stack_has_the_exposure_of_each_band_or_none(tmp_path, first_gain, second, exposures, said):
    parts = [part(tmp_path, 1, time=0.1, gain=first_gain), part(tmp_path, 2, **second)]
    stack = stack_bands(parts, tmp_path)
    assert (stack.facts.get("exposure_s"), stack.facts.get("gain", 1.0)) == (exposures, 1.0)
    assert len(warnings_of(stack)) == (said is not None)
    assert said is None or said in warnings_of(stack)[0]


def test_a_stack_has_one_f_number_and_exposures_that_fit_it(tmp_path):
    def exposure(*apertures):
        facts = [{"time": 0.1} | ({"f_number": f} if f else {}) for f in apertures]
        stack = stack_bands([part(tmp_path, i, **own) for i, own in enumerate(facts)], tmp_path)
        return stack.total_exposure()

    np.testing.assert_allclose(present(exposure(2.0, 4.0)), [0.1 / 4, 0.1 / 16])
    np.testing.assert_allclose(present(exposure(2.0, 2.0)), [0.1 / 4])


@pytest.mark.parametrize("gains", [(1.0, 1.0), (1.0, 4.0)])
@pytest.mark.parametrize("lacking", [0, 1])
def test_a_stack_keeps_times_and_gains_without_f_numbers_that_only_some_parts_have(tmp_path, lacking, gains):
    facts = [{"time": 0.1, "gain": gain, "f_number": 2.0} for gain in gains]
    del facts[lacking]["f_number"]
    stack = stack_bands([part(tmp_path, i, **own) for i, own in enumerate(facts)], tmp_path)
    np.testing.assert_allclose(np.broadcast_to(present(stack.total_exposure()), 2), 0.1 * np.array(gains))
    assert f"is known of some bands and not of {lacking}: exposures are compared" in warnings_of(stack)[0]


NO_LUCK = r"a: can't be read \(RuntimeError: no luck at all\)"


@pytest.mark.parametrize(
    ("error", "message"),
    [(RuntimeError("no luck\nat all"), NO_LUCK), (MemoryError(), "a: too little memory")],
)
def test_what_a_library_raises_while_reading_is_an_error_of_the_file(tmp_path, error, message):
    class Failing(Held):
        def array(self):
            raise error

    stored = Numbers((Failing(np.zeros(1)),), (2, 3, 1), "yxb", np.dtype("u1"))
    with pytest.raises(CaptureError, match=message):
        Cube(tmp_path / "a", "npy", (2, 3, 1), np.dtype("u1"), stored).read()


def test_bands_that_are_not_there_are_an_index_error():
    values = np.random.default_rng(0).random((5, 7, 4))
    with pytest.raises(IndexError):
        file_of(values).read(bands=np.array([4]))
    some = file_of(values).read(slice(1, 4), slice(None, None, -1))
    np.testing.assert_array_equal(some, values[1:4, :, ::-1])
