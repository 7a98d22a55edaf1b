"""Where the viewer listens, and what its user reads about that."""

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.access import (
    TrainingViewerOptions,
    ViewerOptions,
    free_port,
    is_local,
    start_notices,
    tunnel_command,
    url_of,
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


def test_a_taken_port_is_passed_over(taken):
    assert taken < free_port("127.0.0.1", taken) <= taken + 20


def test_when_no_port_near_is_free_that_is_said(taken, monkeypatch):
    monkeypatch.setattr("unmix_plugin.viewer.access._PORTS_TRIED", 1)
    with pytest.raises(ConfigError, match=f"no free port from {taken} to {taken} at"):
        free_port("127.0.0.1", taken)


@pytest.mark.parametrize("host", ["203.0.113.7", "no-such-host.invalid"])
def test_an_address_that_is_not_of_this_machine_is_refused(host):
    with pytest.raises(ConfigError, match=r"give an address of this machine, such as 127\.0\.0\.1"):
        free_port(host, 7007)


@pytest.mark.parametrize(
    ("host", "local"),
    [
        ("127.0.0.1", True),
        ("127.8.8.8", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.1.5", False),
        ("example.org", False),
    ],
)
def test_only_loopback_is_local(host, local):
    assert is_local(host) is local


def test_the_address_printed_can_be_opened():
    assert url_of("127.0.0.1", 7007) == "http://127.0.0.1:7007"
    assert url_of("0.0.0.0", 7008) == "http://localhost:7008"
    assert url_of("::1", 7007) == "http://[::1]:7007"


def test_a_local_viewer_says_its_address_and_nothing_else():
    assert start_notices(ViewerOptions(), 7007, {}) == ["viewer: http://127.0.0.1:7007"]
    assert start_notices(ViewerOptions(port=0), 5555, {}) == ["viewer: http://127.0.0.1:5555"]


def test_a_viewer_that_others_reach_warns_and_asks_for_a_token():
    lines = start_notices(ViewerOptions(host="0.0.0.0"), 7007, {})
    assert lines[1].startswith("warning: everyone who reaches ")
    assert "give --viewer.token" in lines[1]
    assert "with the token" in start_notices(ViewerOptions(host="0.0.0.0", token="sesame"), 7007, {})[1]
    assert "sesame" not in "".join(start_notices(ViewerOptions(host="0.0.0.0", token="sesame"), 7007, {}))


def test_over_ssh_the_tunnel_to_the_real_port_is_said():
    remote = {"SSH_CONNECTION": "10.0.0.2 50022 10.0.0.9 22", "USER": "ada"}
    lines = start_notices(ViewerOptions(), 7009, remote)
    assert lines[1] == "port 7007 is taken, hence 7009"
    assert "ssh -N -L 7009:127.0.0.1:7009 ada@10.0.0.9" in lines[2]
    other = {"SSH_CONNECTION": "10.0.0.2 50022 10.0.0.9 2222"}
    assert tunnel_command(7007, other) == "ssh -N -L 7007:127.0.0.1:7007 -p 2222 10.0.0.9"


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
