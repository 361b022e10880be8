"""The web server: bound to one known address, closed to other web sites, without tunnels to the outside."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import socket
from collections.abc import Iterator

import viser
import viser._messages
import websockets.asyncio.server

from mild_viz.dashboard.address import is_loopback
from mild_viz.errors import UserError

PORTS_TRIED = 200


def _can_bind(host: str, port: int) -> bool:
    """Whether a server could listen there. Raises UserError for an address that is not this machine's."""
    try:
        infos = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):  # UnicodeError: a label that is empty or too long for any name
        raise UserError(f"host '{host}' is unknown; valid: an address of this machine, such as 127.0.0.1") from None
    for family, kind, protocol, _, address in infos:
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(address)
            except PermissionError:
                raise UserError(f"port {port} may not be used by this account; valid: 1024 to 65535") from None
            except OSError as error:
                if error.errno == errno.EADDRNOTAVAIL:
                    raise UserError(f"host '{host}' is no address of this machine; valid: such as 127.0.0.1") from None
                return False
    return True


def free_port(host: str, first: int) -> int | None:
    """The first free port from `first` on, if any."""
    return next((port for port in range(first, min(first + PORTS_TRIED, 65536)) if _can_bind(host, port)), None)


def check_port(host: str, port: int) -> None:
    """Refuse a port that is taken, naming the next that is free: viser itself would silently use another."""
    if not 1 <= port <= 65535:
        raise UserError(f"port {port} is no port; valid: 1 to 65535")
    if not _can_bind(host, port):
        other = free_port(host, port + 1)
        offer = f"; the next free one is {other}: --port {other}" if other else ""
        raise UserError(f"port {port} is already in use{offer}")


@contextlib.contextmanager
def _only_from(origins: list[str | None] | None) -> Iterator[None]:
    """Make the websocket refuse pages of other sites.

    viser checks no Origin, so any site that is open in the browser could drive this page. websockets can check
    it, but viser does not pass the option through: give it while the server starts.
    """
    original = websockets.asyncio.server.serve
    websockets.asyncio.server.serve = functools.partial(original, origins=origins)  # pyright: ignore
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original


def open_server(host: str, port: int, label: str) -> viser.ViserServer:
    """Start a viser server on exactly this address.

    Raises:
        UserError: if the port is taken (with the next free one) or the host is not this machine's.
    """
    check_port(host, port)
    # A program (a test, a script) sends no Origin. On a network the page's own address cannot be known beforehand.
    names = {f"[{host}]" if ":" in host else host, "localhost", "127.0.0.1"}
    origins: list[str | None] | None = [None, *(f"http://{name}:{port}" for name in sorted(names))]
    if not is_loopback(host):
        origins = None
    with _only_from(origins), contextlib.redirect_stdout(io.StringIO()):  # viser prints a table of its own
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    if server.get_port() != port:
        taken = server.get_port()
        server.stop()
        raise UserError(f"port {port} was taken while starting; another free one is {taken}: --port {taken}")
    # The page must not be able to open a tunnel to the internet, with or without the button.
    server._websock_server.unregister_handler(viser._messages.ShareUrlRequest)
    return server
