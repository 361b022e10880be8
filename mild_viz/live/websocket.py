"""Websockets: frames from a server to which we connect, commands to clients that connect to us."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import logging
import socket
import threading
from collections.abc import Callable, Coroutine

from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed

from mild_viz.errors import UserError
from mild_viz.live.address import Address, bind, check_options, host_and_port
from mild_viz.live.inputs import FedInput
from mild_viz.live.messages import JointCommand, encode
from mild_viz.live.outputs import Output

FIRST_PAUSE, LONGEST_PAUSE = 0.2, 2.0
"""Between attempts to connect [s]; it doubles from one to the other."""

MAX_CLIENTS = 16
"""Clients that may listen at once."""

MAX_WAITING = 65536
"""Bytes that may wait for one client (some hundred commands) before it counts as slow and is disconnected."""

_QUEUED = 8
"""Commands that may wait for the sending thread; older ones are of no use to a robot."""

_QUIET = logging.getLogger("mild_viz.live.websocket")
_QUIET.addHandler(logging.NullHandler())
_QUIET.propagate = False  # what strangers send wrong is counted, and belongs on nobody's terminal


class LoopThread:
    """A coroutine in a thread of its own, until it is cancelled by `close`."""

    def __init__(self, main: Callable[[], Coroutine[None, None, None]], name: str) -> None:
        self._main = main
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()
        self._ready.wait()

    def _run(self) -> None:
        with contextlib.suppress(asyncio.CancelledError):
            asyncio.run(self._start())

    async def _start(self) -> None:
        self.loop = asyncio.get_running_loop()
        task = asyncio.current_task()
        assert task is not None
        self._task = task
        self._ready.set()
        await self._main()

    def call(self, function: Callable[[], object]) -> None:
        """Run a function there soon; nothing happens once it has ended."""
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self.loop.call_soon_threadsafe(function)

    def close(self) -> None:
        """Cancel it, and wait a few seconds for its end."""
        self.call(self._task.cancel)
        self._thread.join(timeout=3.0)


class WebsocketInput(FedInput):
    """Connects to a server that sends one frame a message, again and again until it is there."""

    def __init__(self, address: Address) -> None:
        super().__init__(address.text)
        self.trouble = f"{self.name}: not connected yet"
        self._thread = LoopThread(self._receive, f"input {self.name}")

    async def _receive(self) -> None:
        pause = FIRST_PAUSE
        while True:
            try:
                # Uncompressed: these messages are small, and come from nearby. No proxy, for the same reason.
                async with connect(
                    self.name, compression=None, proxy=None, open_timeout=5, close_timeout=1, logger=_QUIET
                ) as connection:
                    self.trouble = ""
                    while True:
                        message = await connection.recv()
                        pause = FIRST_PAUSE
                        self._feed(message.encode() if isinstance(message, str) else message, self.name)
            except Exception as error:  # whatever it is, the next attempt may succeed
                self.trouble = f"{self.name}: {getattr(error, 'strerror', None) or error or 'no answer'}"
            await asyncio.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE)

    def close(self) -> None:
        super().close()
        self._thread.close()


class WebsocketOutput(Output):
    """A server that sends every command to all who listen. Who does not keep up is disconnected, never waited for.

    Programs may connect; pages in a browser only from an `origin` that the address names (`?origin=http://...`),
    as any site that is open in a browser could connect otherwise.
    """

    def __init__(self, address: Address, joint_names: tuple[str, ...]) -> None:
        check_options(address, ("origin",))
        if address.place not in ("", "/"):
            raise UserError(f"output '{address.text}': a path means nothing here; expected: ws://127.0.0.1:9871")
        self._socket = bind(address, socket.SOCK_STREAM)
        super().__init__(f"ws://{host_and_port(self._socket.getsockname())}", joint_names)
        # Small, so that a client who stops reading is noticed after a few hundred kilobytes, not after megabytes.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MAX_WAITING)
        self._socket.listen()  # from now on clients may come, though the thread takes a moment to start
        self._origins = [None, *(origin for origin in [address.options.get("origin")] if origin)]
        self._clients: set[ServerConnection] = set()
        self._queue: collections.deque[JointCommand] = collections.deque(maxlen=_QUEUED)
        self._lock = threading.Lock()
        self._closed = False
        self._thread = LoopThread(self._serve, f"output {self.name}")

    def send(self, command: JointCommand) -> None:
        with self._lock:
            if self._closed:
                return
            self.counts.dropped += len(self._queue) == _QUEUED
            self._queue.append(command)
            wake = len(self._queue) == 1
        if wake:
            self._thread.call(self._broadcast)

    async def _serve(self) -> None:
        async with serve(
            self._client,
            sock=self._socket,
            origins=self._origins,
            compression=None,
            max_size=1024,
            open_timeout=5,
            close_timeout=1,
            logger=_QUIET,
        ):
            await asyncio.Event().wait()

    async def _client(self, connection: ServerConnection) -> None:
        if len(self._clients) >= MAX_CLIENTS:
            await connection.close(1013, f"{MAX_CLIENTS} clients are connected, which is the most")
            return
        self._clients.add(connection)
        self.counts.receivers = len(self._clients)
        try:
            async for _ in connection:  # what clients say means nothing; unread, it would stop their answers to pings
                pass
        except ConnectionClosed:
            pass
        finally:
            self._forget(connection)

    def _forget(self, connection: ServerConnection) -> None:
        self._clients.discard(connection)
        self.counts.receivers = len(self._clients)

    def _broadcast(self) -> None:
        """Send what is queued, in the thread of the loop."""
        while True:
            with self._lock:
                if not self._queue:
                    return
                command = self._queue.popleft()
            for client in [each for each in self._clients if each.transport.get_write_buffer_size() > MAX_WAITING]:
                self.counts.slow_receivers += 1
                self._forget(client)
                client.transport.abort()
            if not self._clients:
                self.counts.unheard += 1
                continue
            try:
                broadcast(self._clients, encode(command).decode())
                self.counts.sent += 1
            except Exception as error:  # whatever it is, the next command is tried
                self._failed(error)

    def close(self) -> None:
        with self._lock:
            if self._closed:
                return
            self._closed = True
        self._thread.call(self._broadcast)
        self._thread.close()
        self._socket.close()
