"""Readers of files that strangers make either read them or refuse them with the error that they promise."""

import pytest

from tests.fuzz.fuzzing import fuzz, prepare
from tests.fuzz.readers import READERS

CASES = 200
"""A reader, for a few seconds in all; `python benchmarks/fuzz.py` runs many more."""
SLOWEST_S, MOST_BYTES = 5.0, 10**9
WITH_REFUSED_SAMPLES = ("picture", "label picture")
"""Some of their samples are of a format or a mode that isn't accepted."""


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


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_damaged_files_raise_only_what_the_reader_promises(name, tmp_path):
    outcome = fuzz(name, tmp_path, seed=0, cases=range(CASES))
    assert outcome.cases == CASES
    assert outcome.foreign == []
    assert outcome.slowest_s < SLOWEST_S, f"case {outcome.slowest_case}"
    assert outcome.most_bytes < MOST_BYTES, f"case {outcome.largest_case}"
    assert outcome.accepted < CASES
