"""Joint commands out: one interface over every transport; UDP, CSV and none (the others have modules of their own)."""

from __future__ import annotations

import collections
import csv
import io
import os
import socket
import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from mild_viz.errors import UserError
from mild_viz.live.address import Address, check_options, parse, resolve
from mild_viz.live.messages import JointCommand, encode

OUTPUTS = {
    "udp": "udp://HOST:PORT",
    "ws": "ws://127.0.0.1:9871",
    "csv": "csv:FILE",
    "rosbridge": "rosbridge://HOST:PORT",
    "none": "none",
}
"""An example of every kind of output."""


@dataclass
class OutputCounts:
    """What became of every command. Those that are in none of the four are still queued."""

    sent: int = 0
    """Handed to the network to at least one receiver, or written."""
    dropped: int = 0
    """Left out for newer ones, because the receiver or the disk is slow."""
    unheard: int = 0
    """Made while nobody was connected."""
    failed: int = 0
    """Neither sent nor written: `last_error` says why."""
    last_error: str = ""
    receivers: int = 0
    """Connected at present, where the transport knows them."""
    slow_receivers: int = 0
    """Disconnected because they did not keep up."""


class Output(ABC):
    """Takes commands. The control thread calls `send`, which neither raises nor waits."""

    def __init__(self, name: str, joint_names: tuple[str, ...]) -> None:
        self.name = name
        """For people: an address, with the port that was chosen where 0 was asked for."""
        self.joint_names = joint_names
        self.counts = OutputCounts()
        self.trouble = ""
        """Why nothing can be sent at present; empty where all is well."""

    @abstractmethod
    def send(self, command: JointCommand) -> None:
        """Pass a command on."""

    @abstractmethod
    def close(self) -> None:
        """Send what is queued (for a few seconds at most), then stop. Later commands are ignored."""

    def _failed(self, error: Exception) -> None:
        self.counts.failed += 1
        self.counts.last_error = f"{self.name}: {getattr(error, 'strerror', None) or error}"


class NoOutput(Output):
    """Sends nothing, for trying a model out."""

    def send(self, command: JointCommand) -> None:
        self.counts.unheard += 1

    def close(self) -> None:
        pass


class UdpOutput(Output):
    """One command a datagram, sent by the control thread itself: that does not wait, and no other thread delays it."""

    def __init__(self, address: Address, joint_names: tuple[str, ...]) -> None:
        check_options(address, ())
        family, place = resolve(address, socket.SOCK_DGRAM)
        super().__init__(address.text, joint_names)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect(place)  # sends nothing; so the system tells when nobody listens there
        except OSError as error:
            self._socket.close()
            raise UserError(f"{address.text} cannot be reached: {error.strerror or error}") from None
        self._closed = False

    def send(self, command: JointCommand) -> None:
        if self._closed:
            return
        try:
            payload = encode(command)
            try:
                self._socket.send(payload)
            except ConnectionRefusedError:  # of the command before: nobody took it, and this one was not sent yet
                self.counts.sent -= 1
                self.counts.unheard += 1
                self.trouble = f"{self.name}: nobody listens there"
                self._socket.send(payload)
            else:
                self.trouble = ""
            self.counts.sent += 1
        except BlockingIOError:
            self.counts.dropped += 1
        except Exception as error:  # whatever it is, the control thread goes on
            self._failed(error)

    def close(self) -> None:
        self._closed = True
        self._socket.close()


class QueuedOutput(Output):
    """Commands that a thread of its own writes; when it is slow, the oldest are left out."""

    def __init__(self, name: str, joint_names: tuple[str, ...], queued: int) -> None:
        super().__init__(name, joint_names)
        self._queue: collections.deque[JointCommand] = collections.deque(maxlen=queued)
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name=f"output {name}", daemon=True)

    @abstractmethod
    def _write(self, command: JointCommand) -> None:
        """Write one command, in the thread. May raise and wait; counts what it did unless it raises."""

    def send(self, command: JointCommand) -> None:
        with self._changed:
            if self._closed:
                return
            self.counts.dropped += len(self._queue) == self._queue.maxlen
            self._queue.append(command)
            self._changed.notify()

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._queue and not self._closed:
                    self._changed.wait()
                if not self._queue:
                    return
                command = self._queue.popleft()
            try:
                self._write(command)
            except Exception as error:  # whatever it is, the next command is tried
                self._failed(error)

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=3.0)


class CsvOutput(QueuedOutput):
    """One line a command, whole or not at all, in a file that nothing else is in."""

    def __init__(self, address: Address, joint_names: tuple[str, ...]) -> None:
        if not address.place:
            raise UserError(f"output '{address.text}' names no file; expected: csv:FILE")
        super().__init__(address.text, joint_names, queued=1024)
        stiffness = [f"{name}_stiffness" for name in joint_names]
        header = _line(
            ["timestamp", "sequence", "observed", "phase", "contact", "fired", *joint_names, *stiffness],
        )
        self._file = _own_file(address.place, header)
        self._size = len(header)
        self._thread.start()

    def _write(self, command: JointCommand) -> None:
        if command.joint_names != self.joint_names:
            raise ValueError(f"command {command.sequence} is for other joints than the columns")
        if not (np.isfinite(command.positions).all() and np.isfinite(command.stiffness).all()):
            raise ValueError(f"command {command.sequence} holds a number that is not finite")
        line = _line(
            [
                repr(command.timestamp),
                command.sequence,
                "" if command.observed is None else repr(command.observed),
                command.phase,
                int(command.contact),
                ";".join(command.fired),
                *map(repr, command.positions.tolist()),
                *map(repr, command.stiffness.tolist()),
            ]
        )
        try:
            if os.write(self._file, line) != len(line):
                raise OSError("the disk is full")
        except OSError as error:
            self.trouble = f"{self.name}: {error.strerror or error}"
            os.ftruncate(self._file, self._size)  # the lines before stay whole
            raise
        self.trouble = ""
        self._size += len(line)
        self.counts.sent += 1

    def close(self) -> None:
        super().close()
        if not self._thread.is_alive() and self._file >= 0:
            os.close(self._file)
            self._file = -1


def _line(values: list[object]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(values)
    return text.getvalue().encode()


def _own_file(place: str, header: bytes) -> int:
    """The file to append to, beginning with `header`: a new one, or one of ours in which no command is yet."""
    flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
    try:
        file = os.open(
            place, flags | getattr(os, "O_NONBLOCK", 0), 0o666
        )  # non-blocking: a pipe would wait for a reader
    except OSError as error:
        raise UserError(f"{place} cannot be written: {error.strerror or error}; choose another place") from None
    try:
        held = os.read(file, len(header) + 1)
        if held not in (b"", header):
            raise UserError(f"{place} exists and is not overwritten; choose another file, or remove it")
        if not held and os.write(file, header) != len(header):
            raise OSError("the disk is full")
    except (OSError, UserError) as error:
        os.close(file)
        if isinstance(error, UserError):
            raise
        raise UserError(f"{place} cannot be written: {error.strerror or error}; choose another place") from None
    return file


def open_output(spec: str, joint_names: tuple[str, ...]) -> Output:
    """The output at an address such as those in `OUTPUTS`, for commands to these joints.

    Raises:
        UserError: if the address is unusable, taken, or needs what is not there; nothing was written then.
    """
    address = parse(spec, "output", OUTPUTS)
    if address.scheme == "none":
        return NoOutput(address.text, joint_names)
    if address.scheme == "csv":
        return CsvOutput(address, joint_names)
    if address.scheme == "ws":
        from mild_viz.live.websocket import WebsocketOutput

        return WebsocketOutput(address, joint_names)
    if address.scheme == "rosbridge":
        from mild_viz.live.rosbridge import RosbridgeOutput

        return RosbridgeOutput(address, joint_names)
    return UdpOutput(address, joint_names)
