"""Skeleton frames in: one interface over every transport, and UDP (the others have modules of their own)."""

from __future__ import annotations

import collections
import contextlib
import selectors
import socket
import struct
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from mild_viz.errors import UserError
from mild_viz.live.address import Address, bind, check_options, host_and_port, parse
from mild_viz.live.messages import MAX_BYTES, Observation, decode
from mild_viz.live.order import Order

INPUTS = {
    "udp": "udp://127.0.0.1:9870",
    "ws": "ws://HOST:PORT",
    "replay": "replay:DATASET/TRIAL",
    "rosbridge": "rosbridge://HOST:PORT",
}
"""An example of every kind of input."""

QUEUED = 64
"""Most frames that are decoded at once: one second's at 60 Hz. Those before them are older than is useful."""

_MOST_AT_ONCE = 4096
"""Datagrams that one `poll` reads at most; a full socket buffer holds a few hundred."""

_STAMP = getattr(socket, "SO_TIMESTAMPNS", 35) if sys.platform == "linux" else None
"""Linux's option to have the kernel note when a datagram arrived. Python knows its name from 3.14 on."""

_TIMESPEC = struct.Struct("@ll")


@dataclass
class InputCounts:
    """What became of every frame.

    `received` is the sum of `delivered`, `rejected`, `duplicated`, `reordered`, `foreign` and `skipped`.
    """

    received: int = 0
    delivered: int = 0
    """Returned by `poll`."""
    rejected: int = 0
    """Unusable: `last_error` says why."""
    duplicated: int = 0
    reordered: int = 0
    """Older than one that was used."""
    foreign: int = 0
    """From another sender, or another person, than the one that is followed; `last_foreign` names it."""
    skipped: int = 0
    """Usable, but a newer one was there too: the caller is slower than the sender."""
    restarts: int = 0
    """The sender started anew, its clock jumped, or another one took its place."""
    last_error: str = ""
    last_foreign: str = ""


class Input(ABC):
    """A source of skeleton frames. The control thread calls `poll`; it never raises."""

    def __init__(self, name: str) -> None:
        self.name = name
        """For people: an address, with the port that was chosen where 0 was asked for."""
        self.counts = InputCounts()
        self.trouble = ""
        """Why nothing can arrive at present; empty where all is well."""
        self.finished = False
        """Nothing will arrive any more."""

    @abstractmethod
    def poll(self, timeout: float) -> Observation | None:
        """The newest usable frame that is there, or the first to arrive within `timeout` [s]; None if none does."""

    def close(self) -> None:
        """Stop receiving. Later calls of `poll` return None."""
        self.finished = True


class StreamInput(Input):
    """Frames that others send whenever they like: checks, order, and the newest of what is there."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._order = Order()

    @abstractmethod
    def _drain(self) -> Iterable[tuple[Any, float, str]]:
        """Payload, time of arrival and source of all that has arrived, at most `QUEUED`, without waiting."""

    @abstractmethod
    def _wait(self, seconds: float) -> None:
        """Return when something has arrived, or after so long."""

    def _decode(self, payload: Any, received: float, source: str) -> Observation:
        return decode(payload, received, source)

    def poll(self, timeout: float) -> Observation | None:
        deadline = time.perf_counter() + timeout
        while not self.finished:
            seen = self._newest()
            if seen is not None:
                self.counts.delivered += 1
                return seen
            remaining = deadline - time.perf_counter()
            if remaining <= 0:
                break
            self._wait(remaining)
        return None

    def _newest(self) -> Observation | None:
        counts, newest = self.counts, None
        for payload, received, source in self._drain():
            try:
                seen = self._decode(payload, received, source)
            except UserError as error:
                counts.rejected += 1
                counts.last_error = f"{source}: {error}"
                continue
            verdict = self._order.judge(seen)
            if verdict == "new":
                counts.skipped += newest is not None
                newest = seen
            elif verdict == "duplicated":
                counts.duplicated += 1
            elif verdict == "reordered":
                counts.reordered += 1
            else:
                counts.foreign += 1
                counts.last_foreign = source if seen.person is None else f"{source}, person '{seen.person}'"
        counts.restarts = self._order.restarts
        return newest


class FedInput(StreamInput):
    """Frames that another thread receives and hands over by `_feed`."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._queue: collections.deque[tuple[Any, float, str]] = collections.deque(maxlen=QUEUED)
        self._lock = threading.Lock()
        self._arrived = threading.Event()

    def _feed(self, payload: Any, source: str) -> None:
        with self._lock:
            self.counts.received += 1
            self.counts.skipped += len(self._queue) == QUEUED  # the oldest makes room
            self._queue.append((payload, time.perf_counter(), source))
        self._arrived.set()

    def _drain(self) -> Iterable[tuple[Any, float, str]]:
        with self._lock:
            self._arrived.clear()
            queued = list(self._queue)
            self._queue.clear()
        return queued

    def _wait(self, seconds: float) -> None:
        self._arrived.wait(seconds)

    def close(self) -> None:
        super().close()
        self._arrived.set()


class UdpInput(StreamInput):
    """One frame a datagram. The control thread itself reads the socket: no other thread stands between."""

    def __init__(self, address: Address) -> None:
        check_options(address, ())
        self._socket = bind(address, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        # A full buffer drops what is newest. The system grants less than this, but more than it gives unasked.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**22)
        self._kernel_stamps = False
        if _STAMP is not None:
            with contextlib.suppress(OSError):
                self._socket.setsockopt(socket.SOL_SOCKET, _STAMP, 1)
                self._kernel_stamps = True
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._socket, selectors.EVENT_READ)
        self._empty_at = time.perf_counter()
        super().__init__(f"udp://{host_and_port(self._socket.getsockname())}")

    def _drain(self) -> Iterable[tuple[Any, float, str]]:
        counts = self.counts
        newest: collections.deque[tuple[Any, float, str]] = collections.deque(maxlen=QUEUED)
        for _ in range(_MOST_AT_ONCE):
            before = time.perf_counter()
            try:
                payload, received, source = self._receive()
            except BlockingIOError:
                self._empty_at = before
                break
            except OSError as error:
                if not self.finished:
                    counts.last_error = f"{self.name}: {error.strerror or error}"
                    time.sleep(0.001)  # an error that stays must not take the processor
                break
            counts.received += 1
            # Known without decoding, so that a stranger's flood cannot push out the sender that is followed.
            if self._order.follows_another(source, received):
                counts.foreign += 1
                counts.last_foreign = source
                continue
            counts.skipped += len(newest) == QUEUED
            newest.append((payload, received, source))
        return newest

    def _receive(self) -> tuple[bytes, float, str]:
        """One datagram (cut off one byte beyond the longest message), when it arrived, and who sent it."""
        if not self._kernel_stamps:
            payload, place = self._socket.recvfrom(MAX_BYTES + 1)
            return payload, time.perf_counter(), host_and_port(place)
        payload, ancillary, _, place = self._socket.recvmsg(MAX_BYTES + 1, 64)
        received = time.perf_counter()
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _STAMP) and len(data) >= _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack_from(data)
                waited = (time.time_ns() - (seconds * 1_000_000_000 + nanoseconds)) * 1e-9
                # It cannot have waited since before the queue was empty, whatever is done to this machine's clock.
                received = max(received - max(waited, 0.0), self._empty_at)
        return payload, received, host_and_port(place)

    def _wait(self, seconds: float) -> None:
        try:
            self._selector.select(seconds)
        except (OSError, ValueError, RuntimeError):  # closed meanwhile
            self.finished = True

    def close(self) -> None:
        super().close()
        self._selector.close()
        self._socket.close()


def open_input(spec: str) -> Input:
    """The input at an address such as those in `INPUTS`.

    Raises:
        UserError: if the address is unusable, taken, or needs what is not there (a dataset, a package).
    """
    address = parse(spec, "input", INPUTS)
    # Each transport is imported when it is needed, so that one does not pay for the others.
    if address.scheme == "replay":
        from mild_viz.live.replay import ReplayInput

        return ReplayInput(address)
    if address.scheme == "ws":
        from mild_viz.live.websocket import WebsocketInput

        return WebsocketInput(address)
    if address.scheme == "rosbridge":
        from mild_viz.live.rosbridge import RosbridgeInput

        return RosbridgeInput(address)
    return UdpInput(address)
