"""Frames in by UDP and from recordings, over the loopback: order, faults of senders, lateness, and what is counted."""

from __future__ import annotations

import itertools
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from live_messages import accounted, arrives, frame, sequences

from mild_viz.data.skeletons import ARM_JOINTS
from mild_viz.errors import UserError
from mild_viz.live import order
from mild_viz.live.inputs import QUEUED, Input, UdpInput, open_input
from mild_viz.live.replay import find_trial, recorded_joints
from mild_viz.trial import Dataset


@pytest.fixture
def source() -> Iterator[Input]:
    opened = open_input("udp://127.0.0.1:0")
    yield opened
    opened.close()


def port_of(source: Input) -> int:
    return int(source.name.rpartition(":")[2])


class Sender:
    """A program that sends datagrams. Over the loopback they are in the receiver's queue when `send` returns."""

    def __init__(self, source: Input) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port_of(source)))
        self.name = f"127.0.0.1:{self.socket.getsockname()[1]}"

    def __call__(self, *payloads: bytes) -> None:
        for payload in payloads:
            self.socket.send(payload)


@pytest.fixture
def send(source: Input) -> Iterator[Sender]:
    sender = Sender(source)
    yield sender
    sender.socket.close()


@pytest.fixture
def other(source: Input) -> Iterator[Sender]:
    sender = Sender(source)
    yield sender
    sender.socket.close()


def test_a_frame_arrives_as_it_was_sent(source: Input, send: Sender) -> None:
    before = time.perf_counter()
    send(frame(7, person="2"))
    seen = source.poll(1.0)
    assert seen is not None and before <= seen.received <= time.perf_counter()
    assert (seen.sequence, seen.timestamp, seen.source, seen.person) == (7, 100 + 7 / 30, send.name, "2")
    np.testing.assert_array_equal(seen.positions, [[0, -0.2, 0], [0, -0.2, -0.3], [0.007, -0.2, -0.3]])
    assert source.poll(0.0) is None
    assert (source.counts.received, source.counts.delivered, source.trouble) == (1, 1, "")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says when a datagram arrived")
def test_what_waited_counts_from_its_arrival(source: Input, send: Sender) -> None:
    """So that the time which the control thread was busy is in the latency."""
    send(frame(1))
    time.sleep(0.3)
    read = time.perf_counter()
    seen = source.poll(0.0)
    assert seen is not None and seen.received < read - 0.15  # half of it: two clocks are read, one after the other


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says when a datagram arrived")
@pytest.mark.parametrize("shift", [-3600, 3600])
def test_a_jump_of_this_machines_clock_does_not_make_latencies_absurd(
    source: Input, send: Sender, monkeypatch: pytest.MonkeyPatch, shift: int
) -> None:
    assert source.poll(0.0) is None
    empty = time.perf_counter()
    send(frame(1))
    real = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real() + shift * 1_000_000_000)
    seen = source.poll(0.0)
    assert seen is not None and empty - 0.005 <= seen.received <= time.perf_counter()


def test_without_the_kernels_times_frames_arrive_too(source: Input, send: Sender) -> None:
    assert isinstance(source, UdpInput)
    source._kernel_stamps = False  # as on other systems than Linux
    before = time.perf_counter()
    send(frame(1))
    seen = source.poll(0.0)
    assert seen is not None and before <= seen.received <= time.perf_counter() and seen.source == send.name


def test_ten_times_the_rate_leaves_no_backlog(source: Input, send: Sender) -> None:
    numbers = itertools.count()
    for _ in range(30):
        last = None
        for last in itertools.islice(numbers, 10):
            send(frame(last, 100 + last / 600))
        assert sequences(source, 2) == [last]
    counts = source.counts
    assert (counts.received, counts.delivered, counts.skipped) == (300, 30, 270) and accounted(counts)


def test_after_a_pause_of_the_reader_only_the_newest_is_used(source: Input, send: Sender) -> None:
    send(*(frame(number) for number in range(3 * QUEUED)))
    assert sequences(source, 2) == [3 * QUEUED - 1]
    assert source.counts.skipped == 3 * QUEUED - 1 and accounted(source.counts)


def test_late_repeated_and_unusable_frames_are_counted_and_the_stream_goes_on(source: Input, send: Sender) -> None:
    seen = []
    wrong = frame(5, joints={"right_wrsit": [0, 0, 0]})
    for payload in (frame(1), frame(1), frame(3), frame(2), b"\xff{", wrong, b"", b"x" * 20000, frame(6)):
        send(payload)
        seen += sequences(source, 1)
    counts = source.counts
    assert seen == [1, 3, 6]
    assert (counts.duplicated, counts.reordered, counts.rejected) == (1, 1, 4) and accounted(counts)
    assert counts.last_error == f"{send.name}: the message is longer than 16384 bytes"


def test_a_wrong_joint_name_is_named_with_the_nearest(source: Input, send: Sender) -> None:
    send(frame(1, joints={"right_wrsit": [0, 0, 0]}))
    assert source.poll(0.0) is None
    assert source.counts.last_error == f"{send.name}: joint \"right_wrsit\" is unknown; did you mean 'right_wrist'?"


def test_a_sender_that_stops_and_resumes(source: Input, send: Sender) -> None:
    send(frame(1))
    assert sequences(source, 1) == [1]
    begin = time.perf_counter()
    assert source.poll(0.05) is None
    assert time.perf_counter() - begin > 0.045
    assert not source.finished
    threading.Timer(0.05, send, [frame(2)]).start()
    assert arrives(source).sequence == 2


def test_a_sender_whose_clock_jumps_loses_one_frame(source: Input, send: Sender) -> None:
    seen: list[Any] = []
    for number in range(20):
        send(frame(None, (100.0 if number < 10 else -4000.0) + number / 30))
        seen.append(source.poll(0.0) is not None)
    assert seen == [True] * 10 + [False] + [True] * 9
    assert source.counts.restarts == 1 and accounted(source.counts)


def test_a_second_sender_is_named_and_takes_over_when_the_first_is_silent(
    source: Input, send: Sender, other: Sender, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(5):
        send(frame(number))
        other(frame(900 + number))
        assert sequences(source, 1) == [number]
    assert source.counts.foreign == 5 and source.counts.last_foreign == other.name
    time.sleep(0.12)
    with monkeypatch.context() as patch:
        patch.setattr(order, "SILENCE", 0.1)  # only now: above and below, frames may take longer on a busy machine
        other(frame(950))
        assert sequences(source, 1) == [950]
    send(frame(6))
    assert sequences(source, 1) == []
    assert source.counts.foreign == 6 and source.counts.last_foreign == send.name and accounted(source.counts)


def test_of_two_people_of_one_sender_the_first_is_followed(source: Input, send: Sender) -> None:
    for number in range(3):
        send(frame(number, person="left"), frame(number, person="right"))
        seen = source.poll(0.0)
        assert seen is not None and seen.person == "left"
    assert source.counts.foreign == 3
    assert source.counts.last_foreign == f"{send.name}, person 'right'"


def test_a_strangers_flood_does_not_push_out_the_sender_that_is_followed(
    source: Input, send: Sender, other: Sender
) -> None:
    send(frame(1))
    assert sequences(source, 1) == [1]
    send(frame(2))
    other(*[b"garbage"] * (2 * QUEUED))
    assert sequences(source, 1) == [2]
    assert source.counts.foreign == 2 * QUEUED and source.counts.rejected == 0


def test_endless_garbage_does_not_hold_the_reader(source: Input, send: Sender) -> None:
    stop = threading.Event()

    def flood() -> None:
        while not stop.is_set():
            send(b"garbage")

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        for _ in range(3):
            begin = time.perf_counter()
            assert source.poll(0.03) is None
            assert time.perf_counter() - begin < 2.0  # it would never return; the machine may be slow
    finally:
        stop.set()
        thread.join()
    assert source.counts.rejected > 0


def test_closing_ends_a_poll_and_frees_the_port(source: Input, send: Sender) -> None:
    port = port_of(source)
    send(frame(1))
    source.close()
    assert source.finished and source.poll(1.0) is None
    open_input(f"udp://127.0.0.1:{port}").close()


def test_a_port_that_is_taken_is_named(source: Input) -> None:
    with pytest.raises(UserError, match=f"udp://127.0.0.1:{port_of(source)} cannot be bound: Address already in use"):
        open_input(source.name)


def test_without_a_host_only_this_machine_can_send() -> None:
    opened = open_input("udp://:0")
    assert opened.name.startswith("udp://127.0.0.1:")
    opened.close()


WRONG = {
    "": "input '' is unknown; valid: udp://127.0.0.1:9870, ws://HOST:PORT, replay:DATASET/TRIAL, rosbridge://",
    "udp": "is unknown; valid",
    "none": "is unknown; valid",
    "tcp://127.0.0.1:9870": "is unknown; valid",
    "udp:127.0.0.1:9870": "has no host and port; expected: udp://127.0.0.1:9870",
    "udp://127.0.0.1": "has no host and port",
    "udp://127.0.0.1:99999": "is no address",
    "udp://[::1:9870": "is no address",
    "udp://me@127.0.0.1:9870": "has no host and port",
    "udp://nowhere.invalid:9870": "host 'nowhere.invalid' is unknown",
    "udp://192.0.2.1:9870": "cannot be bound",
    "udp://127.0.0.1:9870?rate=3": "option 'rate' is unknown; valid: none",
    "replay:nuisi": "replay:nuisi names no trial",
    "replay:nuisi/test/x": "names no trial",
    "replay:nuisi/test/1/2": "names no trial",
    "replay:nuisy/1": "dataset 'nuisy' is unknown",
    "replay:demo/9999": "demo/test has no trial 9999",
    "replay:demo/exam/1": "split 'exam' is unknown",
    "replay:demo/0?rat=3": "option 'rat' is unknown; did you mean 'rate'?",
    "replay:demo/0?rate=fast": "rate is 'fast'; expected: a number from 1 to 1000",
    "replay:demo/0?rate=nan": "rate is 'nan'",
    "replay:demo/0?speed=0": "expected: a number from 0.01 to 100",
    "replay:demo/0?loop=yes": "loop is 'yes'; valid: 0, 1",
    "replay:demo/0?loop": "expected: ?name=value&name=value",
}


@pytest.mark.parametrize("spec", WRONG)
def test_wrong_addresses_are_refused(spec: str) -> None:
    with pytest.raises(UserError) as refusal:
        open_input(spec)
    assert WRONG[spec] in str(refusal.value)


def test_a_recorded_trial_is_played_in_real_time(dataset: Callable[[str], Dataset]) -> None:
    trial = dataset("nuisi").trial("test", 3)
    source = open_input("replay:nuisi/test/3?speed=20&rate=600")
    time.sleep(0.05)  # the clock does not run yet
    begin = time.perf_counter()
    played = []
    while not source.finished:
        seen = source.poll(1.0)
        if seen is not None:
            played.append(seen)
    assert time.perf_counter() - begin >= (trial.n_frames - 1) / 600
    assert played[-1].sequence == trial.n_frames - 1
    for seen in played:
        assert seen.sequence is not None
        np.testing.assert_array_equal(seen.positions, trial.human_arm[seen.sequence])
        assert seen.timestamp == seen.sequence / 600
        assert seen.received >= begin + seen.timestamp - 1e-9
        assert seen.received - played[0].received == pytest.approx(seen.timestamp - played[0].timestamp, abs=1e-9)
        assert (seen.names, seen.coordinates, seen.source) == (ARM_JOINTS, "person", "replay:nuisi/test/3")
    assert source.counts.delivered == len(played) and source.counts.received == trial.n_frames
    assert accounted(source.counts) and source.poll(0.1) is None


def test_a_late_reader_gets_the_newest_frame_of_a_recording() -> None:
    source = open_input("replay:demo/0")
    begin = time.perf_counter()
    assert sequences(source, 1) == [0]
    time.sleep(0.2)
    (number,) = sequences(source, 1)
    assert number is not None and 5 <= number <= 30 * (time.perf_counter() - begin)
    assert source.counts.skipped == number - 1 and accounted(source.counts)


def test_another_rate_samples_the_same_motion() -> None:
    trial = find_trial("demo/4")
    assert trial.name == "demo/test/4"
    names, body = recorded_joints(trial)
    source = open_input("replay:demo/4?rate=60")
    played = [arrives(source) for _ in range(20)]
    source.close()
    assert len({seen.sequence for seen in played}) == 20
    for seen in played:
        assert seen.names == names and seen.sequence is not None
        before, odd = divmod(seen.sequence, 2)
        between = (body[before] + body[before + odd]) / 2
        np.testing.assert_allclose(seen.positions, between, atol=1e-12)
        assert seen.timestamp == seen.sequence / 60


def test_a_loop_starts_over_and_its_clock_goes_on() -> None:
    n_frames = find_trial("demo/0").n_frames
    source = open_input(f"replay:demo/0?rate=1000&speed={1000 / 30}&loop=1")
    played = []
    while (number := arrives(source).sequence or 0) < n_frames + 5:
        played.append(number)
    assert not source.finished and played == sorted(set(played))
    seen = arrives(source)
    assert seen.sequence is not None and seen.timestamp == seen.sequence / 1000
    _, body = recorded_joints(find_trial("demo/0"))
    np.testing.assert_array_equal(seen.positions, body[seen.sequence % n_frames])
    source.close()
    assert source.finished and source.poll(0.1) is None


@pytest.mark.parametrize("place", ["demo/0", "demo/train/3", "handover/test/5", "yumi/0"])
def test_the_arm_in_a_replayed_frame_is_the_recordings(place: str, dataset: Callable[[str], Dataset]) -> None:
    """What the live loop gets is what the model is evaluated on."""
    dataset(place.split("/")[0])
    trial = find_trial(place)
    names, body = recorded_joints(trial)
    np.testing.assert_array_equal(body[:, [names.index(name) for name in ARM_JOINTS]], trial.human_arm)
    opened = open_input(f"replay:{place}")
    np.testing.assert_array_equal(arrives(opened).positions, body[0])
