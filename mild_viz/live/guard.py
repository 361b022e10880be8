"""The last look at a command before it leaves: whatever went wrong before, a robot gets no number that could harm it.

Independent of the safety filter and of how the command came about. On a sound command it changes nothing.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

Joints = Float[np.ndarray, " J"]

SLACK = 1e-9
"""What rounding may add to a limit [rad]."""


class Guard:
    """Keeps positions [rad] within limits, and within `velocity` [rad/s] of the last ones that left."""

    def __init__(self, lower: Joints, upper: Joints, velocity: Joints, start: Joints, period: float) -> None:
        self._lower, self._upper = lower, upper
        self._step = velocity * period
        self._last = np.clip(start, lower, upper)
        self.refused = 0
        """Commands that had to be changed."""

    @property
    def last(self) -> Joints:
        """The last positions that left."""
        return self._last

    def check(self, positions: Joints, stiffness: Joints) -> tuple[Joints, Joints]:
        """Positions and stiffness that may leave: the given ones, or the nearest allowed. NaN stands for the last."""
        wanted = np.where(np.isfinite(positions), positions, self._last)
        allowed = np.clip(wanted, self._last - self._step - SLACK, self._last + self._step + SLACK)
        allowed = np.clip(allowed, self._lower, self._upper)
        soft = np.clip(np.where(np.isfinite(stiffness), stiffness, 1.0), 0.0, 1.0)
        self.refused += not (np.array_equal(allowed, positions) and np.array_equal(soft, stiffness))
        self._last = allowed
        return allowed, soft
