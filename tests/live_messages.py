"""What senders and receivers of live messages say, for tests of the transports."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from mild_viz.live.inputs import Input, InputCounts
from mild_viz.live.messages import JointCommand, Observation

JOINTS = ("RShoulderPitch", "RElbowRoll")


def frame(sequence: int | None, timestamp: float | None = None, **changed: Any) -> bytes:
    """A frame whose wrist is at x = sequence / 1000, at 30 Hz unless a timestamp is given."""
    number = sequence or 0
    message = {
        "version": 1,
        "type": "skeleton",
        "timestamp": 100.0 + number / 30 if timestamp is None else timestamp,
        "sequence": sequence,
        "coordinates": "person",
        "joints": {
            "right_shoulder": [0.0, -0.2, 0.0],
            "right_elbow": [0.0, -0.2, -0.3],
            "right_wrist": [number / 1000, -0.2, -0.3],
        },
    }
    return json.dumps({**message, **changed}).encode()


def command(sequence: int, **changed: Any) -> JointCommand:
    values: dict[str, Any] = {
        "timestamp": 1.75e9 + sequence / 30,
        "sequence": sequence,
        "observed": 100.0 + sequence / 30,
        "joint_names": JOINTS,
        "positions": np.array([0.1, sequence / 1000]),
        "stiffness": np.array([1.0, 0.25]),
        "phase": "reach",
        "contact": False,
        "fired": ("contact", "no way back"),
    }
    return JointCommand(**{**values, **changed})


def accounted(counts: InputCounts) -> bool:
    """Whether every frame that was received is in exactly one of the other counts."""
    parts = ("delivered", "rejected", "duplicated", "reordered", "foreign", "skipped")
    return counts.received == sum(getattr(counts, part) for part in parts)


def sequences(source: Input, polls: int, timeout: float = 0.0) -> list[int | None]:
    """The sequence numbers of what so many polls return."""
    seen = [source.poll(timeout) for _ in range(polls)]
    return [each.sequence for each in seen if each is not None]


def arrives(source: Input, within: float = 5.0) -> Observation:
    """The next frame, which must arrive."""
    deadline = time.perf_counter() + within
    while time.perf_counter() < deadline:
        seen = source.poll(0.1)
        if seen is not None:
            return seen
    raise AssertionError(f"nothing arrives from {source.name}: {source.trouble} {source.counts}")


def eventually(true: Callable[[], object], within: float = 5.0) -> None:
    """Wait for something that another thread does."""
    deadline = time.perf_counter() + within
    while not true():
        assert time.perf_counter() < deadline, "it does not happen"
        time.sleep(0.005)
