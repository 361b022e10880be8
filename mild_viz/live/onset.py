"""When an interaction begins and ends: the hand leaves its resting place, and comes back.

As the authors' controller does it: the resting hand is averaged, a displacement starts the interaction, nearness to the
resting place ends it. Distances do not depend on the frame, so that positions in any fixed frame will do.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from jaxtyping import Float

from mild_viz.live.config import LiveConfig

CALIBRATING, WAITING, INTERACTING, RETURNING = "calibrating", "waiting", "interacting", "returning"
PHASES = (CALIBRATING, WAITING, INTERACTING, RETURNING)
"""calibrating: the hand has not rested long enough yet; waiting: it rests, the robot waits; interacting: the robot
responds; returning: the robot's arm goes back to rest, whatever the person does."""


class PhaseTracker:
    """The phase of the interaction, from the time and place of the hand alone."""

    def __init__(self, config: LiveConfig) -> None:
        self._config = config
        self._recent: deque[tuple[float, Float[np.ndarray, " 3"]]] = deque()
        """Time and place of the hand while it may be resting."""
        self._since: float | None = None
        """Since when the hand has been where the phase ends."""
        self._began = 0.0
        self.phase = CALIBRATING
        self.rest: Float[np.ndarray, " 3"] | None = None
        """The resting place [m]."""
        self.displacement = float("nan")
        """How far the hand is from it [m]."""
        self.reason = ""
        """Why the last interaction ended."""

    def update(self, time: float, hand: Float[np.ndarray, " 3"]) -> str:
        """The phase after one more look at the hand [m]; NaN where it is not tracked. Time [s] must not decrease."""
        tracked = bool(np.isfinite(hand).all())
        self.displacement = float(np.linalg.norm(hand - self.rest)) if tracked and self.rest is not None else np.nan
        if self.phase == CALIBRATING:
            if tracked:
                self._calibrate(time, hand)
        elif self.phase == WAITING:
            self._wait(time, hand, tracked)
        elif self.phase == INTERACTING:
            self._interact(time, hand, tracked)
        return self.phase

    def end(self, reason: str) -> None:
        """End the interaction for a reason that the hand does not tell."""
        if self.phase == INTERACTING:
            self._enter(RETURNING)
            self.reason = reason

    def rested(self) -> None:
        """The robot's arm is back at rest: find the hand's resting place again."""
        if self.phase == RETURNING:
            self.forget()

    def forget(self) -> None:
        """Whoever rested is not there any more."""
        self._enter(CALIBRATING)
        self.rest = None

    def _enter(self, phase: str) -> None:
        self.phase, self._since = phase, None
        self._recent.clear()

    def _calibrate(self, time: float, hand: Float[np.ndarray, " 3"]) -> None:
        mean = self._stillness(time, hand, self._config.calibration, 0.5 * self._config.start_displacement)
        if mean is not None:
            self._enter(WAITING)
            self.rest = mean
            self.displacement = float(np.linalg.norm(hand - mean))

    def _wait(self, time: float, hand: Float[np.ndarray, " 3"], tracked: bool) -> None:
        assert self.rest is not None
        step = time - self._began
        self._began = time
        if not tracked or self.displacement < self._config.start_displacement:
            self._since = None
            if tracked:
                share = min(max(step, 0.0), 0.1) / self._config.adaptation
                self.rest = self.rest + share * (hand - self.rest)
            return
        self._since = time if self._since is None else self._since
        if time - self._since >= self._config.start_duration:
            self._enter(INTERACTING)
            self._began = time

    def _interact(self, time: float, hand: Float[np.ndarray, " 3"], tracked: bool) -> None:
        config, lasted = self._config, time - self._began
        if lasted >= config.longest:
            self.end(f"it has lasted {config.longest:g} s")
            return
        if not tracked:
            self._since = None
            return
        still = self._stillness(time, hand, config.end_still, config.start_displacement) is not None
        if self.displacement >= config.end_distance:
            self._since = None
        elif self._since is None:
            self._since = time
        if lasted < config.shortest:
            return
        if self._since is not None and time - self._since >= config.end_duration:
            self.end("the hand is back")
        elif still:
            self.end("the hand has come to rest")

    def _stillness(
        self, time: float, hand: Float[np.ndarray, " 3"], duration: float, radius: float
    ) -> Float[np.ndarray, " 3"] | None:
        """The mean place of the last `duration` [s], if the hand was never farther from it than `radius` [m]."""
        recent = self._recent
        recent.append((time, hand))
        while len(recent) > 1 and time - recent[1][0] >= duration:
            recent.popleft()
        if time - recent[0][0] < duration:
            return None
        places = np.array([place for _, place in recent])
        mean = places.mean(axis=0)
        return mean if float(np.linalg.norm(places - mean, axis=1).max()) <= radius else None
