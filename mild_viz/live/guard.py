"""The last look at a command before it leaves: whatever went wrong before, a robot gets no number that could harm it.

Independent of the safety filter and of how the command came about. On a sound command it changes nothing.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

Joints = Float[np.ndarray, " J"]

SLACK = 1e-9
"""What rounding may add to a limit [rad]."""


LEAST_SECONDS = 1e-3
"""A command that follows sooner [s] repeats the last one; its time counts for the next."""

MOST_SECONDS = 0.2
"""However long nothing was sent, a command is so much time's way from the last one at most [s]."""


class Guard:
    """Keeps positions [rad] within limits, and as near to the last ones as `velocity` [rad/s] allows."""

    def __init__(self, lower: Joints, upper: Joints, velocity: Joints, start: Joints) -> None:
        self._lower, self._upper, self._velocity = lower, upper, velocity
        self._sent: float | None = None
        self._last = np.clip(start, lower, upper)
        self.refused = 0
        """Commands that had to be changed."""

    @property
    def last(self) -> Joints:
        """The last positions that left."""
        return self._last

    def check(self, positions: Joints, stiffness: Joints, now: float) -> tuple[Joints, Joints]:
        """Positions and stiffness that may leave at `now` [s]: the given ones, or the nearest allowed. NaN stands for
        the last."""
        elapsed = MOST_SECONDS if self._sent is None else now - self._sent
        step = self._velocity * min(max(elapsed, 0.0), MOST_SECONDS) + SLACK
        if elapsed >= LEAST_SECONDS:
            self._sent = now
        else:
            step = np.zeros_like(step)
        wanted = np.where(np.isfinite(positions), positions, self._last)
        allowed = np.clip(wanted, self._last - step, self._last + step)
        allowed = np.clip(allowed, self._lower, self._upper)
        soft = np.clip(np.where(np.isfinite(stiffness), stiffness, 1.0), 0.0, 1.0)
        self.refused += not (np.array_equal(allowed, positions) and np.array_equal(soft, stiffness))
        self._last = allowed
        return allowed, soft
