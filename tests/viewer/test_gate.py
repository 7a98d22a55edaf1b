"""Who may use the viewer."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.viewer import gate
from unmix_plugin.viewer.gate import Gate, is_of_another_site


def test_without_a_word_everyone_is_admitted():
    assert Gate(None).is_open
    assert Gate(None).admits("")


@given(st.text())
def test_only_the_word_itself_is_admitted(word):
    assert Gate("sésame").admits(word) is (word == "sésame")


def test_a_second_try_in_the_same_moment_is_refused_even_if_it_is_right(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(gate.time, "monotonic", lambda: now[0])
    guarded = Gate("sesame")
    assert not guarded.admits("barley")
    now[0] += 0.4
    assert not guarded.admits("sesame")
    now[0] += 0.6
    assert guarded.admits("sesame")


@pytest.mark.parametrize(
    ("headers", "foreign"),
    [
        ({"Origin": "http://127.0.0.1:7007", "Host": "127.0.0.1:7007"}, False),
        ({"origin": "http://LOCALHOST:7007", "host": "localhost:7007"}, False),
        ({"Host": "127.0.0.1:7007"}, False),
        ({}, False),
        ({"Origin": "https://evil.example", "Host": "127.0.0.1:7007"}, True),
        ({"Origin": "http://127.0.0.1:8000", "Host": "127.0.0.1:7007"}, True),
        ({"Origin": "null", "Host": "127.0.0.1:7007"}, True),
        ({"Origin": "http://rebound.example:7007", "Host": "127.0.0.1:7007"}, True),
    ],
)
def test_pages_of_other_sites_are_told_by_their_origin(headers, foreign):
    assert is_of_another_site(headers) is foreign
