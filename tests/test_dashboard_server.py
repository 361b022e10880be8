"""The server: one known address, closed to other web sites; and what a browser sends is checked."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator

import pytest
import viser
import viser._messages
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from mild_viz.dashboard.address import is_loopback, page_url
from mild_viz.dashboard.server import check_port, free_port, open_server
from mild_viz.dashboard.tabs.widgets import number, offer, on_person, option
from mild_viz.errors import UserError

HOST = "127.0.0.1"


def a_free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = open_server(HOST, a_free_port(), "test")
    yield server
    server.stop()


def test_a_taken_port_is_refused_and_the_next_free_one_named() -> None:
    with socket.socket() as other:
        other.bind((HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(UserError, match=f"port {port} is already in use") as caught:
            open_server(HOST, port, "test")
        offered = int(str(caught.value).rsplit(" ", 1)[1])
        assert offered > port
        check_port(HOST, offered)


def test_free_port_skips_what_is_taken() -> None:
    with socket.socket() as other:
        other.bind((HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        found = free_port(HOST, port)
        assert found is not None and found > port


@pytest.mark.parametrize("port", [0, -1, 65536])
def test_a_number_that_is_no_port_is_refused(port: int) -> None:
    with pytest.raises(UserError, match="valid: 1 to 65535"):
        check_port(HOST, port)


def test_an_address_of_another_machine_is_refused() -> None:
    with pytest.raises(UserError, match=r"192\.0\.2\.1.* no address of this machine"):
        check_port("192.0.2.1", a_free_port())


def test_which_addresses_only_this_machine_reaches() -> None:
    assert is_loopback("127.0.0.1") and is_loopback("localhost") and is_loopback("::1")
    assert not is_loopback("0.0.0.0") and not is_loopback("192.168.1.2") and not is_loopback("example.org")


@pytest.mark.parametrize(
    ("host", "url"),
    [
        ("127.0.0.1", "http://127.0.0.1:80"),
        ("0.0.0.0", "http://127.0.0.1:80"),
        ("::", "http://[::1]:80"),
        ("example.org", "http://example.org:80"),
    ],
)
def test_the_address_that_is_printed_opens_in_a_browser(host: str, url: str) -> None:
    assert page_url(host, 80) == url


def websocket(server: viser.ViserServer, origin: str | None):
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    url = f"ws://{HOST}:{server.get_port()}"
    return connect(url, subprotocols=[protocol], origin=None if origin is None else Origin(origin), max_size=None)


def test_pages_of_other_sites_cannot_connect(server: viser.ViserServer) -> None:
    for origin in ("http://evil.example", f"http://evil.example:{server.get_port()}", "https://127.0.0.1", "null"):
        with pytest.raises(InvalidStatus, match="403"), websocket(server, origin):
            pass


def test_the_page_itself_and_programs_can_connect(server: viser.ViserServer) -> None:
    port = server.get_port()
    for origin in (f"http://{HOST}:{port}", f"http://localhost:{port}", None):
        with websocket(server, origin) as connection:
            assert connection.recv(timeout=5.0)


def test_no_tunnel_to_the_internet_can_be_asked_for(server: viser.ViserServer) -> None:
    assert not server._websock_server._incoming_handlers.get(viser._messages.ShareUrlRequest)


def test_numbers_are_put_back_into_their_range(server: viser.ViserServer) -> None:
    slider = server.gui.add_slider("weight", 0.0, 2.0, 0.1, 1.0)
    slider.value = 1e9
    assert number(slider) == 2.0 and slider.value == 2.0
    slider.value = -math.inf
    with pytest.raises(UserError, match="weight is -inf; valid: 0 to 2"):
        number(slider)
    slider.value = math.nan
    with pytest.raises(UserError, match="weight is nan"):
        number(slider)


def test_an_unknown_option_is_refused_and_put_back(server: viser.ViserServer) -> None:
    dropdown = server.gui.add_dropdown("fruit", ("apple", "pear"))
    dropdown.value = "../../etc/passwd"  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(UserError, match=r"fruit '../../etc/passwd' is unknown; valid: apple, pear"):
        option(dropdown)
    assert option(dropdown) == "apple"


def test_offering_other_options_keeps_the_selection_where_it_can(server: viser.ViserServer) -> None:
    dropdown = server.gui.add_dropdown("fruit", ("apple", "pear"), initial_value="pear")
    offer(dropdown, ("plum", "pear"))
    assert dropdown.value == "pear"
    offer(dropdown, ("plum", "fig"))
    assert dropdown.value == "plum"
    offer(dropdown, ("plum", "fig"), "fig")
    assert dropdown.value == "fig"


def test_what_the_program_sets_does_not_count_as_a_change(server: viser.ViserServer) -> None:
    slider = server.gui.add_slider("weight", 0.0, 2.0, 0.1, 1.0)
    changes: list[None] = []
    on_person(slider, lambda: changes.append(None))
    slider.value = 1.5
    assert changes == []


@pytest.mark.parametrize("host", ["a..b", "x" * 70])
def test_a_host_that_is_no_name_is_named(host: str) -> None:
    with pytest.raises(UserError, match="is unknown; valid: an address of this machine"):
        check_port(host, 8080)
