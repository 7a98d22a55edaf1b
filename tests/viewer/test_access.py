"""Where the viewer listens, what its user reads about that, and who may use it."""

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.access import (
    MOST_WAITING,
    Gate,
    TrainingViewerOptions,
    ViewerOptions,
    free_port,
    is_own_page,
    start_notices,
)


@pytest.fixture
def taken():
    """A port that someone listens at."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield listening.getsockname()[1]


def test_a_free_port_is_taken_as_it_is_and_zero_means_any():
    port = free_port("127.0.0.1", 0)
    assert port > 1023
    assert free_port("127.0.0.1", port) == port


def test_when_no_port_near_is_free_that_is_said(taken, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.access._PORTS_TRIED", 1)
    with pytest.raises(ConfigError, match=f"no free port from {taken} to {taken} at"):
        free_port("127.0.0.1", taken)


@pytest.mark.parametrize("host", ["203.0.113.7", "no-such-host.invalid"])
def test_an_address_that_is_not_of_this_machine_is_refused(host):
    with pytest.raises(ConfigError, match=r"give an address of this machine, such as 127\.0\.0\.1"):
        free_port(host, 7007)


@pytest.mark.parametrize(
    ("host", "address"),
    [("127.0.0.1", "127.0.0.1"), ("127.8.8.8", "127.8.8.8"), ("::1", "[::1]"), ("localhost", "localhost")],
)
def test_a_local_viewer_says_its_address_and_nothing_else(host, address):
    assert start_notices(ViewerOptions(host), 7007, {}) == [f"viewer: http://{address}:7007"]
    assert start_notices(ViewerOptions(host, port=0), 5555, {}) == [f"viewer: http://{address}:5555"]


def test_a_viewer_that_others_reach_warns_and_asks_for_a_token():
    for host, address in (("0.0.0.0", "localhost"), ("::", "localhost"), ("lab.example", "lab.example")):
        first, warning = start_notices(ViewerOptions(host), 7007, {})
        assert first == f"viewer: http://{address}:7007"
        assert warning.startswith("warning: everyone who reaches ")
        assert "give --viewer.token" in warning
    assert "with the token" in start_notices(ViewerOptions(host="0.0.0.0", token="sesame"), 7007, {})[1]
    assert "sesame" not in "".join(start_notices(ViewerOptions(host="0.0.0.0", token="sesame"), 7007, {}))


def test_over_ssh_the_tunnel_to_the_real_port_is_said():
    remote = {"SSH_CONNECTION": "10.0.0.2 50022 10.0.0.9 22", "USER": "ada"}
    lines = start_notices(ViewerOptions(), 7009, remote)
    assert lines[1] == "port 7007 is taken, hence 7009"
    assert "ssh -N -L 7009:127.0.0.1:7009 ada@10.0.0.9" in lines[2]
    other = {"SSH_CONNECTION": "10.0.0.2 50022 10.0.0.9 2222"}
    command = "ssh -N -L 7007:127.0.0.1:7007 -p 2222 10.0.0.9"
    assert command in start_notices(ViewerOptions(), 7007, other)[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"port": -1}, "--viewer.port is a number from 0"),
        ({"port": 70_000}, "found 70000"),
        ({"host": " "}, "--viewer.host is empty"),
        ({"token": ""}, "--viewer.token is empty"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        ViewerOptions(**settings)
    with pytest.raises(ConfigError, match=message):
        TrainingViewerOptions(**settings)


@given(st.one_of(st.floats(max_value=0.04), st.floats(min_value=0.91), st.just(float("nan"))))
def test_impossible_shares_are_refused(share):
    with pytest.raises(ConfigError, match=r"a part from 0\.05 to 0\.9"):
        TrainingViewerOptions(share=share)


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
