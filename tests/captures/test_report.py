"""Remarks: one code, one sentence, several places."""

import json

import pytest

from unmix_plugin.captures.report import Code, Kind, Remark, merged, sentences


def test_equal_remarks_become_one_that_names_all_places():
    cut = [Remark.of(Code.BYTES_LEFT, [name], left=3) for name in ("a", "b", "a")]
    other = Remark.of(Code.BYTES_LEFT, ["c"], left=4)
    assert [(one.where, one.values) for one in merged([*cut, other])] == [
        (("a", "b"), {"left": 3}),
        (("c",), {"left": 4}),
    ]


def test_many_places_are_counted_in_the_sentence():
    remark = Remark.of(Code.BYTES_LEFT, "abcde", left=3)
    assert remark.sentence == "a, b, c and 2 more: 3 bytes more than the header describes"


def test_kinds_are_properties_of_codes_and_tell_where_a_sentence_goes():
    remarks = [Remark.of(Code.NOTE, text="odd"), Remark.of(Code.CAPTURE_WARNING, text="wrong")]
    assert sentences(remarks, Kind.WRONG) == ["wrong"]
    assert sentences(remarks, Kind.DONE) == ["odd"]
    assert [code for code in Code if code.looks_wrong] == [code for code in Code if code.kind is Kind.WRONG]


@pytest.mark.parametrize("code", [Code.CAPTURE_WARNING, Code.NOTE])
def test_a_remark_is_written_with_its_code_and_values(code: Code):
    written = json.loads(json.dumps(Remark.of(code, ["a"], text="cut").to_json()))
    assert written == {"code": code.name.lower(), "where": ["a"], "values": {"text": "cut"}}
