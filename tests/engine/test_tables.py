"""Tables that spreadsheets open: no name of a stranger becomes a formula, numbers stay numbers."""

import csv
import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.engine.tables import csv_bytes
from unmix_plugin.spectral.bands import Bands
from unmix_plugin.spectral.library.spectra_csv import SpectraTable, write_spectra_csv

FORMULAS = ("=1+1", "+SUM(A1)", "-2+3", "@cmd", "\t=1")


def is_formula(cell):
    try:
        float(cell)
    except ValueError:
        return cell[:1] in ("=", "+", "-", "@", "\t", "\r")
    return False


@given(
    st.lists(st.lists(st.one_of(st.text(), st.floats(), st.sampled_from(FORMULAS)), min_size=2, max_size=2))
)
def test_no_cell_is_a_formula_and_every_other_comes_back(rows):
    read = list(csv.reader(io.StringIO(csv_bytes(rows).decode("utf-8", "surrogatepass"), newline="")))
    assert len(read) == len(rows)
    for row, cells in zip(rows, read, strict=True):
        for value, cell in zip(row, cells, strict=True):
            assert not is_formula(cell)
            text = value.replace("\r", "_") if isinstance(value, str) else str(value)
            assert cell == (f"_{text}" if is_formula(text) else text)


@pytest.mark.parametrize("name", FORMULAS)
def test_spectra_have_no_formulas_for_names(tmp_path, name):
    write_spectra_csv(tmp_path / "a.csv", SpectraTable(Bands.of([400.0, 500.0]), (name,), np.ones((1, 2))))
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as file:
        header = next(csv.reader(file))
    assert header == ["wavelength", f"_{name}"]
