"""Who may use the viewer."""

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.viewer.access import MOST_WAITING, Gate, is_own_page


def test_without_a_token_everyone_is_admitted():
    assert Gate(None).is_open
    assert not Gate("sesame").is_open


@given(st.text())
def test_only_the_token_itself_is_admitted(word):
    gate = Gate("sésame")
    gate.enter(1, "10.0.0.1")
    gate.guess(1, word)
    assert gate.verdicts() == {1: word == "sésame"}
    assert gate.verdicts() == {}


def test_each_address_has_one_guess_checked_at_a_time_the_oldest_first():
    gate = Gate("sesame")
    for page, address in ((1, "10.0.0.1"), (2, "10.0.0.1"), (3, "10.0.0.2")):
        gate.enter(page, address)
        gate.guess(page, "barley")
    assert gate.verdicts() == {1: False, 3: False}
    gate.guess(1, "barley")
    assert gate.verdicts() == {2: False}
    assert gate.verdicts() == {1: False}


def test_the_right_token_is_let_in_however_many_guess_wrong():
    gate = Gate("sesame")
    for page in range(MOST_WAITING):
        assert gate.enter(page, "10.0.0.1")
        gate.guess(page, "sesame" if page == 7 else "barley")
    admitted = []
    for _ in range(MOST_WAITING):
        for page, is_right in gate.verdicts().items():
            if is_right:
                admitted.append(page)
            else:
                gate.guess(page, "barley")
    assert admitted == [7]


def test_pages_that_leave_do_not_keep_others_waiting():
    gate = Gate("sesame")
    for page in range(1000):
        gate.enter(page, "10.0.0.1")
        gate.guess(page, "barley")
        gate.leave(page)
    gate.enter(1000, "10.0.0.1")
    gate.guess(1000, "sesame")
    assert gate.verdicts() == {1000: True}


def test_an_address_has_a_limited_number_of_pages_waiting():
    gate = Gate("sesame")
    assert all(gate.enter(page, "10.0.0.1") for page in range(MOST_WAITING))
    assert not gate.enter(100, "10.0.0.1")
    assert gate.enter(101, "10.0.0.2")
    gate.leave(0)
    assert gate.enter(102, "10.0.0.1")


@pytest.mark.parametrize(
    ("headers", "is_own"),
    [
        ({"Origin": "http://127.0.0.1:7007", "Host": "127.0.0.1:7007"}, True),
        ({"origin": "http://LOCALHOST:7007", "host": "localhost:7007"}, True),
        ({"Origin": "http://[::1]:7007", "Host": "[::1]:7007"}, True),
        ({"Origin": "http://192.168.1.5:7007", "Host": "192.168.1.5:7007"}, True),
        ({"Host": "127.0.0.1:7007"}, True),
        ({}, True),
        (None, False),
        ({"Origin": "https://evil.example", "Host": "127.0.0.1:7007"}, False),
        ({"Origin": "http://127.0.0.1:8000", "Host": "127.0.0.1:7007"}, False),
        ({"Origin": "null", "Host": "127.0.0.1:7007"}, False),
        ({"Origin": "http://rebound.example:7007", "Host": "127.0.0.1:7007"}, False),
        ({"Origin": "http://rebound.example:7007", "Host": "rebound.example:7007"}, False),
        ({"Origin": "http://localhost:7007"}, False),
    ],
)
def test_pages_of_other_sites_are_told_by_their_origin_and_host(headers, is_own):
    assert is_own_page(headers, "127.0.0.1") is is_own


def test_a_name_is_own_if_the_viewer_listens_there_and_this_machines_name_if_it_listens_everywhere():
    def page_at(name):
        return {"Origin": f"http://{name}:7007", "Host": f"{name}:7007"}

    assert is_own_page(page_at("lab.example"), "lab.example")
    assert not is_own_page(page_at("lab.example"), "0.0.0.0")
    assert is_own_page(page_at(socket.gethostname()), "0.0.0.0")
