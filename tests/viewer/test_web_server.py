"""The parts of viser that are not public are where `web_server` takes them from."""

import pytest
import viser
from viser import infra

from tests.viewer.pages import opened


def test_the_private_parts_are_those_of_the_version_that_they_were_taken_from(viewer):
    assert viser.__version__.startswith("1.1."), (
        "read web_server.py beside the source of this viser, then name it here"
    )
    server = viewer._server
    with opened(viewer):
        (client,) = server.get_clients().values()
        connection = client._viser_server._websock_server._live_connections[client.client_id]
        assert connection.request.headers["Host"].endswith(str(viewer.port))
        assert connection.remote_address[0] == "127.0.0.1"
        assert client._viser_server._event_loop is server._event_loop
    assert server._websock_server._incoming_handlers


@pytest.mark.usefixtures("viewer")
def test_viser_itself_is_left_as_it_is():
    assert infra.WebsockServer.__module__.startswith("viser")
