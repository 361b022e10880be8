"""Commands out by UDP and CSV: what arrives, receivers and disks that fail, and that the control thread never waits."""

from __future__ import annotations

import csv
import errno
import io
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from disk import full_disk
from live_messages import JOINTS, command, eventually

from mild_viz.errors import UserError
from mild_viz.live.messages import encode
from mild_viz.live.outputs import Output, open_output


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        bound.settimeout(2.0)
        yield bound


def rows(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(path.read_text())))


def typical_send(output: Output, numbers: range) -> float:
    """Send commands, and return the median time that one took [s]: other programs stop this one, too."""
    times = []
    for number in numbers:
        begin = time.perf_counter()
        output.send(command(number))
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def test_commands_arrive_by_udp_as_they_are_written(receiver: socket.socket) -> None:
    output = open_output(f"udp://127.0.0.1:{receiver.getsockname()[1]}", JOINTS)
    for number in range(3):
        output.send(command(number))
        assert receiver.recv(65536) == encode(command(number))
    output.close()
    output.send(command(3))
    assert (output.counts.sent, output.counts.failed, output.trouble) == (3, 0, "")


def test_a_udp_receiver_that_is_not_there_is_noticed_and_found_when_it_comes(receiver: socket.socket) -> None:
    place = receiver.getsockname()
    receiver.close()
    output = open_output(f"udp://127.0.0.1:{place[1]}", JOINTS)
    for number in range(10):
        output.send(command(number))
    counts = output.counts
    assert output.trouble == f"{output.name}: nobody listens there"
    assert counts.unheard >= 8 and counts.sent + counts.unheard == 10 and counts.failed == 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as late:
        late.bind(place)
        late.settimeout(2.0)
        output.send(command(10))
        assert late.recv(65536) == encode(command(10))
        output.send(command(11))
        assert late.recv(65536) == encode(command(11)) and output.trouble == ""
    output.close()


def test_a_command_that_is_not_finite_is_not_sent(receiver: socket.socket) -> None:
    output = open_output(f"udp://127.0.0.1:{receiver.getsockname()[1]}", JOINTS)
    output.send(command(1, positions=np.array([np.nan, 0.0])))
    assert output.counts.failed == 1 and "command 1 holds a number that is not finite" in output.counts.last_error
    output.send(command(2))
    assert receiver.recv(65536) == encode(command(2))
    output.close()


def test_a_network_that_fails_is_counted(receiver: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
    output = open_output(f"udp://127.0.0.1:{receiver.getsockname()[1]}", JOINTS)
    for error in (OSError(errno.ENETUNREACH, "Network is unreachable"), BlockingIOError()):

        class Failing:
            def send(self, payload: bytes, error: OSError = error) -> int:
                raise error

        with monkeypatch.context() as patch:
            patch.setattr(output, "_socket", Failing())
            output.send(command(1))
    assert (output.counts.failed, output.counts.dropped, output.counts.sent) == (1, 1, 0)
    assert output.counts.last_error == f"{output.name}: Network is unreachable"
    output.close()


def test_no_output_takes_everything() -> None:
    output = open_output("none", JOINTS)
    output.send(command(1))
    output.close()
    assert (output.name, output.counts.unheard) == ("none", 1)


def test_a_csv_file_holds_every_command_exactly(tmp_path: Path) -> None:
    path = tmp_path / "a, b.csv"
    output = open_output(f"csv:{path}", JOINTS)
    sent = [command(number, observed=None if number == 1 else 100 + number / 3) for number in range(3)]
    for each in sent:
        output.send(each)
    output.close()
    assert path.read_text().splitlines()[0] == (
        "timestamp,sequence,observed,phase,contact,fired,"
        "RShoulderPitch,RElbowRoll,RShoulderPitch_stiffness,RElbowRoll_stiffness"
    )
    for row, each in zip(rows(path), sent, strict=True):
        assert (float(row["timestamp"]), int(row["sequence"])) == (each.timestamp, each.sequence)
        assert row["observed"] == ("" if each.observed is None else repr(each.observed))
        assert (row["phase"], row["contact"], row["fired"]) == ("reach", "0", "contact;no way back")
        assert [float(row[name]) for name in JOINTS] == each.positions.tolist()
        assert [float(row[f"{name}_stiffness"]) for name in JOINTS] == each.stiffness.tolist()
    assert (output.counts.sent, output.counts.failed, output.trouble) == (3, 0, "")


def test_lines_are_in_the_file_before_it_is_closed(tmp_path: Path) -> None:
    """A killed program leaves what it wrote."""
    output = open_output(f"csv:{tmp_path / 'a.csv'}", JOINTS)
    output.send(command(1))
    eventually(lambda: len(rows(tmp_path / "a.csv")) == 1)
    output.close()


def test_a_csv_file_is_not_overwritten_but_one_without_commands_is_used(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    open_output(f"csv:{path}", JOINTS).close()
    header = path.read_text()
    output = open_output(f"csv:{path}", JOINTS)
    output.send(command(1))
    output.close()
    held = path.read_text()
    assert held.startswith(header) and len(rows(path)) == 1
    for joints in (JOINTS, ("other",)):
        with pytest.raises(UserError, match="a.csv exists and is not overwritten"):
            open_output(f"csv:{path}", joints)
    assert path.read_text() == held
    path.write_text("")
    open_output(f"csv:{path}", JOINTS).close()
    assert path.read_text() == header


def test_places_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # nobody reads it: opening it would wait for ever
    for place in (tmp_path, tmp_path / "missing" / "a.csv", tmp_path / "pipe"):
        with pytest.raises(UserError, match="choose another"):
            open_output(f"csv:{place}", JOINTS)
    with full_disk(20), pytest.raises(UserError, match="cannot be written: the disk is full"):
        open_output(f"csv:{tmp_path / 'b.csv'}", JOINTS)


def test_a_full_disk_is_counted_leaves_whole_lines_and_may_have_room_again(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    output = open_output(f"csv:{path}", JOINTS)
    with full_disk(600):
        for number in range(20):
            output.send(command(number))
        eventually(lambda: output.counts.sent + output.counts.failed == 20)
    written = output.counts.sent
    assert 0 < written < 20 and output.counts.failed == 20 - written
    assert output.trouble and output.counts.last_error == output.trouble
    held = path.read_bytes()
    assert held.endswith(b"\n") and len(held) <= 600
    numbers = [int(row["sequence"]) for row in rows(path)]
    assert len(numbers) == written and numbers == sorted(set(numbers)) and all(None not in row for row in rows(path))
    output.send(command(20))
    output.close()
    assert [int(row["sequence"]) for row in rows(path)] == [*numbers, 20] and output.trouble == ""


def test_a_command_for_other_joints_is_not_written(tmp_path: Path) -> None:
    output = open_output(f"csv:{tmp_path / 'a.csv'}", JOINTS)
    output.send(command(1, joint_names=("a", "b")))
    output.send(command(2, positions=np.array([np.inf, 0.0])))
    output.send(command(3))
    output.close()
    assert output.counts.failed == 2 and [row["sequence"] for row in rows(tmp_path / "a.csv")] == ["3"]


def test_a_slow_disk_does_not_hold_the_control_thread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    output = open_output(f"csv:{tmp_path / 'a.csv'}", JOINTS)
    stuck, real = threading.Event(), os.write

    def write(file: int, data: bytes) -> int:
        stuck.wait(10)
        return real(file, data)

    monkeypatch.setattr(os, "write", write)
    assert typical_send(output, range(1500)) < 1e-3
    assert output.counts.dropped >= 1500 - 1024 - 1
    stuck.set()
    output.close()
    written = [int(row["sequence"]) for row in rows(tmp_path / "a.csv")]
    assert written[-1024:] == list(range(1500 - 1024, 1500))  # the oldest made room
    assert output.counts.sent + output.counts.dropped == 1500 and len(written) == output.counts.sent


WRONG = {
    "": "output '' is unknown; valid: udp://HOST:PORT, ws://127.0.0.1:9871, csv:FILE, rosbridge://HOST:PORT, none",
    "none:": "is unknown; valid",
    "csv": "is unknown; valid",
    "csv:": "names no file; expected: csv:FILE",
    "udp://127.0.0.1": "has no host and port",
    "udp://nowhere.invalid:9": "host 'nowhere.invalid' is unknown",
    "udp://127.0.0.1:9871?x=1": "option 'x' is unknown",
    "udp://255.255.255.255:9": "cannot be reached: Permission denied",
    "ws://127.0.0.1:9871/path": "a path means nothing here",
    "ws://192.0.2.1:9871": "cannot be bound",
    "ws://127.0.0.1:9871?origins=x": "did you mean 'origin'?",
}


@pytest.mark.parametrize("spec", WRONG)
def test_wrong_addresses_are_refused(spec: str) -> None:
    with pytest.raises(UserError) as refusal:
        open_output(spec, JOINTS)
    assert WRONG[spec] in str(refusal.value)
