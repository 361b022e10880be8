"""Websockets both ways: frames from a server that comes and goes, commands to clients good, slow, late and foreign."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from live_messages import JOINTS, accounted, arrives, command, eventually, frame
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.sync.server import ServerConnection, serve

from mild_viz.errors import UserError
from mild_viz.live import websocket
from mild_viz.live.inputs import QUEUED, open_input
from mild_viz.live.messages import encode
from mild_viz.live.outputs import Output, open_output
from mild_viz.live.websocket import MAX_CLIENTS, MAX_WAITING


@contextlib.contextmanager
def tracker(handler: Callable[[ServerConnection], None], port: int = 0) -> Iterator[int]:
    """A server that sends frames; gives its port. At the end it goes, as a program does: with its connections."""
    connections: list[ServerConnection] = []

    def handled(connection: ServerConnection) -> None:
        connections.append(connection)
        handler(connection)

    with serve(handled, "127.0.0.1", port) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.socket.getsockname()[1]
        finally:
            server.shutdown()
            for connection in connections:
                connection.close()
            thread.join()


def says(*messages: Any) -> Callable[[ServerConnection], None]:
    """What a server does that sends these, then waits for the client to go."""

    def handler(connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            for message in messages:
                connection.send(message)
            connection.recv()

    return handler


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(websocket, "FIRST_PAUSE", 0.02)
    monkeypatch.setattr(websocket, "LONGEST_PAUSE", 0.05)


def test_frames_arrive_as_text_or_bytes() -> None:
    with tracker(says(frame(1).decode(), b"garbage", frame(2))) as port:
        source = open_input(f"ws://127.0.0.1:{port}/frames?of=me")
        eventually(lambda: source.counts.received == 3)
        seen = arrives(source)
        assert (seen.sequence, seen.source) == (2, source.name) and source.trouble == ""
        counts = source.counts
        assert (counts.skipped, counts.rejected, counts.delivered) == (1, 1, 1) and accounted(counts)
        assert "no JSON" in counts.last_error
        source.close()
        assert source.finished and source.poll(1.0) is None


def test_a_reader_that_is_late_gets_the_newest() -> None:
    with tracker(says(*(frame(number) for number in range(3 * QUEUED)))) as port:
        source = open_input(f"ws://127.0.0.1:{port}")
        eventually(lambda: source.counts.received == 3 * QUEUED)
        assert arrives(source).sequence == 3 * QUEUED - 1
        assert source.counts.skipped == 3 * QUEUED - 1 and accounted(source.counts)
        source.close()


def test_a_server_that_goes_and_comes_back() -> None:
    with tracker(says(frame(1))) as port:
        source = open_input(f"ws://127.0.0.1:{port}")
        assert arrives(source).sequence == 1
    eventually(lambda: source.trouble)
    assert source.poll(0.02) is None and not source.finished
    with tracker(says(frame(2)), port):
        assert arrives(source).sequence == 2
        assert source.trouble == source.counts.last_error == "", "it is over"
    source.close()


def test_a_server_that_is_not_there_or_speaks_otherwise_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        source = open_input(f"ws://127.0.0.1:{silent.getsockname()[1]}")
        connection, _ = silent.accept()
        connection.sendall(b"220 mail.example ESMTP\r\n\r\n")
        connection.close()
        eventually(lambda: "not connected yet" not in source.trouble)
        assert source.trouble.startswith(f"{source.name}: ") and len(source.trouble) > len(source.name) + 5
    eventually(lambda: "refused" in source.trouble.lower() or "connect call failed" in source.trouble.lower())
    assert source.poll(0.0) is None
    source.close()


@pytest.fixture
def output() -> Iterator[Output]:
    opened = open_output("ws://127.0.0.1:0", JOINTS)
    yield opened
    opened.close()


def joined(output: Output, clients: int = 1, **options: Any) -> ClientConnection:
    client = connect(output.name, **options)
    eventually(lambda: output.counts.receivers == clients)
    return client


def test_clients_receive_commands_from_when_they_connect(output: Output) -> None:
    output.send(command(0))
    eventually(lambda: output.counts.unheard == 1)
    with joined(output) as first:
        output.send(command(1))
        assert first.recv(2) == encode(command(1)).decode()
        with joined(output, 2) as second:
            output.send(command(2))
            assert first.recv(2) == second.recv(2) == encode(command(2)).decode()
        eventually(lambda: output.counts.receivers == 1)
        output.send(command(3))
        assert json.loads(first.recv(2))["sequence"] == 3
    assert (output.counts.sent, output.counts.failed, output.counts.dropped) == (3, 0, 0)


def test_closing_sends_what_is_queued_and_ends_the_connections(output: Output) -> None:
    with joined(output) as client:
        for number in range(5):
            output.send(command(number))
        output.close()
        output.send(command(5))
        assert [json.loads(client.recv(2))["sequence"] for _ in range(5)] == list(range(5))
        with pytest.raises(ConnectionClosed):
            client.recv(2)
    open_output(output.name, JOINTS).close()  # the port is free again


def test_pages_of_other_sites_are_refused(output: Output) -> None:
    """Any site that is open in a browser can open a websocket to this machine."""
    for origin in ("http://evil.example", "null", output.name.replace("ws", "http")):
        with pytest.raises(InvalidStatus, match="403"):
            connect(output.name, origin=origin)  # type: ignore[arg-type]
    named = open_output("ws://127.0.0.1:0?origin=http://localhost:3000", JOINTS)
    with connect(named.name, origin="http://localhost:3000"):  # type: ignore[arg-type]
        pass
    with pytest.raises(InvalidStatus, match="403"):
        connect(named.name, origin="http://localhost:3001")  # type: ignore[arg-type]
    named.close()


def test_a_client_that_stops_reading_is_disconnected_and_the_others_miss_nothing(output: Output) -> None:
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.connect(("127.0.0.1", int(output.name.rpartition(":")[2])))
    slow.sendall(
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    eventually(lambda: output.counts.receivers == 1)
    with joined(output, 2) as good:
        number, longest = 0, 0.0
        while output.counts.slow_receivers == 0:
            begin = time.perf_counter()
            output.send(command(number))
            longest = max(longest, time.perf_counter() - begin)
            assert json.loads(good.recv(2))["sequence"] == number
            number += 1
            assert number < 20 * MAX_WAITING / len(encode(command(0)))
        eventually(lambda: output.counts.receivers == 1)
        output.send(command(number))
        assert json.loads(good.recv(2))["sequence"] == number
    assert longest < 0.5  # nobody waited for it
    slow.settimeout(2.0)
    with contextlib.suppress(ConnectionResetError):
        while slow.recv(2**20):
            pass  # what was on its way; then the connection ends
    slow.close()


def test_what_clients_say_is_ignored(output: Output) -> None:
    with joined(output) as chatty:
        for _ in range(100):
            chatty.send("hello")
        output.send(command(1))
        assert json.loads(chatty.recv(2))["sequence"] == 1
        chatty.ping().wait(2)
    with joined(output, 1) as loud, contextlib.suppress(ConnectionClosed):
        loud.send("x" * 5000)
    eventually(lambda: output.counts.receivers == 0)


def test_no_more_clients_than_allowed(output: Output) -> None:
    with contextlib.ExitStack() as stack:
        for number in range(MAX_CLIENTS):
            stack.enter_context(joined(output, number + 1))
        with connect(output.name) as extra, pytest.raises(ConnectionClosed, match="1013"):
            extra.recv(2)
        assert output.counts.receivers == MAX_CLIENTS


def test_a_command_that_is_not_finite_is_not_sent(output: Output) -> None:
    with joined(output) as client:
        output.send(command(1, timestamp=float("nan")))
        output.send(command(2))
        assert json.loads(client.recv(2))["sequence"] == 2
    assert output.counts.failed == 1 and "not finite" in output.counts.last_error


def test_a_port_that_is_taken_is_named(output: Output) -> None:
    with pytest.raises(UserError, match="cannot be bound: Address already in use"):
        open_output(output.name, JOINTS)
