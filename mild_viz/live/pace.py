"""From frames at any rate to the model's rate, on a time axis that no clock can turn back.

A model's velocities are differences between frames at the rate it was trained at, and its states last as many steps as
they did there: frames that come faster or slower must not reach it as they come.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

Arm = Float[np.ndarray, "3 3"]

TOLERANCE = 0.25
"""A frame that is off the grid by up to this share of a period is taken as it is: a tracker's jitter."""

FOLLOW = 0.2
"""Share of such an offset by which the grid follows, so that it keeps to a tracker that is a little slow or fast."""

SHORTEST = 1e-4
"""Time between two frames, where the clocks say that none has passed [s]."""


class Clock:
    """The sender's timestamps as seconds since the first frame; where its clock jumps, the time of arrival counts."""

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._last: tuple[float, float] | None = None
        self._now = 0.0
        self.jumps = 0

    def time(self, timestamp: float, received: float) -> float:
        """The time of a frame [s]; greater with every call."""
        if self._last is not None:
            sent, arrived = timestamp - self._last[0], received - self._last[1]
            if sent <= 0.0 or abs(sent - arrived) > self._tolerance:
                self.jumps += 1
                sent = arrived
            self._now += max(sent, SHORTEST)
        self._last = (timestamp, received)
        return self._now


class Pace:
    """Samples arms at a fixed rate [Hz]: as they come where they come at that rate, else by linear interpolation."""

    def __init__(self, rate: float, bridge: float, longest: float) -> None:
        self._period = 1.0 / rate
        self._bridge, self._longest = bridge, longest
        self._next: float | None = None
        self._last_time = 0.0
        self._last: Arm = np.full((3, 3), np.nan)

    def take(self, time: float, arm: Arm) -> list[Arm]:
        """The samples that a frame at this time [s] completes: none, where the frames come faster; several, where they
        come slower. What was missing for longer than `bridge` [s] is NaN; after `longest` [s] the grid starts anew."""
        period, gap = self._period, time - self._last_time
        if self._next is None or gap > self._longest:
            self._next = time
        samples = []
        while self._next < time - TOLERANCE * period:
            share = (self._next - self._last_time) / gap
            known = gap <= self._bridge
            samples.append(self._last + share * (arm - self._last) if known else np.full((3, 3), np.nan))
            self._next += period
        # Of two frames of a fast tracker, the one that is nearer to the grid.
        early = min(TOLERANCE * period, 0.5 * gap) if gap > 0.0 else TOLERANCE * period
        if time >= self._next - early:
            samples.append(arm)
            self._next += period + FOLLOW * (time - self._next)
        self._last_time, self._last = time, arm
        return samples
