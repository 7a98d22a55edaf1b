"""Where the viewer listens, what its user reads about that, and where its token comes from."""

import errno
import socket
from types import SimpleNamespace

import pytest

from unmix_plugin.errors import ConfigError
from unmix_plugin.viewer.access import TrainingViewerOptions, ViewerOptions, free_port, start_notices

ELSEWHERE = {"UNMIX_VIEWER_TOKEN": "barley\n"}


def test_a_free_port_is_taken_as_it_is_zero_means_any_and_when_none_near_is_free_that_is_said(monkeypatch):
    port = free_port("127.0.0.1", 0)
    assert port > 1023
    assert free_port("127.0.0.1", port) == port
    monkeypatch.setattr("unmix_plugin.viewer.access._PORTS_TRIED", 1)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        taken = listening.getsockname()[1]
        with pytest.raises(ConfigError, match=f"no free port from {taken} to {taken} at"):
            free_port("127.0.0.1", taken)


def test_a_port_that_windows_keeps_for_itself_is_not_free(monkeypatch):
    def forbidden(_self, _address):
        raise OSError(errno.EACCES, "forbidden by its access permissions")

    monkeypatch.setattr(socket.socket, "bind", forbidden)
    with pytest.raises(ConfigError, match="a port above 1023"):
        free_port("127.0.0.1", 7007)
    monkeypatch.setattr("unmix_plugin.viewer.access.os", SimpleNamespace(name="nt"))
    with pytest.raises(ConfigError, match="no free port from 7007"):
        free_port("127.0.0.1", 7007)


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


@pytest.mark.parametrize(
    ("host", "address"), [("0.0.0.0", "localhost"), ("::", "localhost"), ("lab.example", "lab.example")]
)
def test_a_viewer_that_others_reach_warns_and_asks_for_a_token_which_it_does_not_say(host, address):
    first, warning = start_notices(ViewerOptions(host), 7007, {})
    assert first == f"viewer: http://{address}:7007"
    assert warning.startswith("warning: everyone who reaches ")
    assert "give --viewer.token" in warning
    for options, variables in ((ViewerOptions(host, token="sesame"), {}), (ViewerOptions(host), ELSEWHERE)):
        said = "".join(start_notices(options, 7007, variables))
        assert "with the token" in said
        assert not {"sesame", "barley"} & {*said.split()}


def test_over_ssh_the_tunnel_to_the_real_port_is_said():
    remote = {"SSH_CONNECTION": "10.0.0.2 50022 10.0.0.9 22", "USER": "ada"}
    lines = start_notices(ViewerOptions(), 7009, remote)
    assert lines[1] == "port 7007 is taken, hence 7009"
    assert "ssh -N -L 7009:127.0.0.1:7009 ada@10.0.0.9" in lines[2]
    other = {"SSH_CONNECTION": "10.0.0.2 50022 10.0.0.9 2222"}
    assert "7007 -p 2222 10.0.0.9" in start_notices(ViewerOptions(), 7007, other)[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"port": -1}, "--viewer.port is a number from 0"),
        ({"port": 70_000}, "found 70000"),
        ({"host": " "}, "--viewer.host is empty"),
        ({"token": ""}, "--viewer.token is empty"),
        *(({"share": share}, r"a part from 0\.05 to 0\.9") for share in (0.04, 0.91, float("nan"))),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    for options in (TrainingViewerOptions, *(() if "share" in settings else (ViewerOptions,))):
        with pytest.raises(ConfigError, match=message):
            options(**settings)


def test_a_token_is_taken_from_the_flag_a_file_or_the_environment(tmp_path):
    file = tmp_path / "token"
    file.write_text("sésame\n", encoding="utf-8")
    assert ViewerOptions().secret({}) is None
    assert ViewerOptions().secret(ELSEWHERE) == "barley"
    assert ViewerOptions(token="sesame").secret(ELSEWHERE) == "sesame"
    assert ViewerOptions(token=f"@{file}").secret(ELSEWHERE) == "sésame"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file"),
        (b"", "is empty"),
        (b"\xff\xfe", "it is no UTF-8 text"),
        (b"x" * 5000, "has 5,000 bytes, and 4,096 at most are read"),
    ],
)
def test_a_file_that_holds_no_token_is_refused(tmp_path, content, message):
    file = tmp_path / "token"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        ViewerOptions(token=f"@{file}").secret({})
    with pytest.raises(ConfigError, match="UNMIX_VIEWER_TOKEN is empty"):
        ViewerOptions().secret({"UNMIX_VIEWER_TOKEN": " "})
