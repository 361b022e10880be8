"""What to do with each observation: wait, begin, respond, hold, return. No clock, thread or socket is in here.

The same observations at the same times give the same decisions, so that a recorded session can be run again.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from mild_viz import streaming
from mild_viz.live.config import LiveConfig
from mild_viz.live.idle import idle
from mild_viz.live.messages import Observation
from mild_viz.live.onset import CALIBRATING, INTERACTING, RETURNING, WAITING, PhaseTracker
from mild_viz.live.pace import Clock, Pace
from mild_viz.live.person import Body
from mild_viz.streaming import Command, StreamModel

Arm = Float[np.ndarray, "3 3"]

AT_REST = 0.01
"""The arm is back when no joint is farther from its resting place [rad]."""

REFERENCES = 32
"""Frames over which the person's frame is averaged where it has to be found: half a second to a second."""


@dataclass
class Counts:
    """What became of the observations."""

    frames: int = 0
    answered: int = 0
    """A command was made of it; of a tracker faster than the model, only every second or third frame asks for one."""
    stale: int = 0
    """Too old when their turn came."""
    implausible: int = 0
    """With a joint that moved too fast."""
    untracked: int = 0
    """Without a whole arm."""
    held: int = 0
    """Commands made without an observation."""


@dataclass(frozen=True, eq=False)
class Decision:
    """What is commanded, and why."""

    phase: str
    interaction: int
    """Number of the interaction, from 1; 0 before the first."""
    command: Command
    samples: tuple[Arm, ...]
    """The arms that the model took for it, in the person's frame [m]; at the start also those before it."""
    answers: bool
    """Whether it answers an observation."""
    note: str = ""
    """Why the robot holds or returns, for people."""


@dataclass
class LiveController:
    """Feed it observations and the passing of time; it says what to command."""

    model: StreamModel
    config: LiveConfig
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        config = self.config
        self.tracker = PhaseTracker(config)
        self.clock = Clock(config.clock)
        self.body = Body()
        self.carry = streaming.start(self.model)
        self.interaction = 0
        self.trouble = ""
        """Why no interaction can begin; empty where one can."""
        self._pace = Pace(self.model.rate, config.bridge, config.gone)
        self._lead: deque[Arm] = deque(maxlen=config.lead_frames(self.model.rate))
        self._references: deque[Float[np.ndarray, "4 3"]] = deque(maxlen=REFERENCES)
        self._last: tuple[float, Arm] | None = None
        self._usable = -np.inf

    @property
    def arm(self) -> Arm:
        """The newest arm, in the person's own frame [m]; NaN where it is not tracked."""
        return np.full((3, 3), np.nan) if self._last is None else self.body.to_person(self._last[1])

    def observe(self, seen: Observation, now: float) -> Decision | None:
        """Take an observation at `now` [s]; None if it asks for no command."""
        self.counts.frames += 1
        if now - seen.received > self.config.stale:
            self.counts.stale += 1
            return None
        time = self.clock.time(seen.timestamp, seen.received)
        arm, reference = self.body.read(seen)
        arm = self._plausible(time, arm)
        if np.isfinite(arm).all():
            self._usable = now
        else:
            self.counts.untracked += 1
        if self._last is not None and time - self._last[0] > self.config.gone:
            self._leave()
        self._last = (time, arm)
        self._references.append(reference)
        samples = self._pace.take(time, arm)
        before = self.tracker.phase
        if before != INTERACTING:
            self._lead.extend(samples)
        self._give_up(now)
        phase = self.tracker.update(time, arm[2])
        if before == WAITING and phase == INTERACTING:
            return self._begin()
        if not samples:
            return None
        self.counts.answered += 1
        if phase == INTERACTING:
            return self._respond([self.body.to_person(sample) for sample in samples])
        return self._rest(answers=True)

    def tick(self, now: float) -> Decision:
        """Decide without an observation, because none came in time."""
        self.counts.held += 1
        self._give_up(now)
        if self.tracker.phase != INTERACTING:
            return self._rest(answers=False)
        self.carry, command = idle(self.model, self.carry, now - self._usable)
        return self._decide(command, (), False, "no usable observation")

    def stop(self) -> None:
        """End the interaction, because the program ends."""
        self.tracker.end("the program ends")

    @property
    def at_rest(self) -> bool:
        """Whether the last command was the resting posture."""
        joints, rest = self.carry.control.joints, self.model.robot.chain.rest
        return bool(np.abs(joints - rest).max() <= AT_REST)

    def _plausible(self, time: float, arm: Arm) -> Arm:
        """The arm; NaN if a joint of it cannot have come there since the last one that was believed."""
        if self._last is None or not np.isfinite(self._last[1]).all():
            return arm
        way = float(np.linalg.norm(arm - self._last[1], axis=1).max())
        if not way > self.config.jump * (time - self._last[0]):
            return arm
        self.counts.implausible += 1
        return np.full((3, 3), np.nan)

    def _give_up(self, now: float) -> None:
        """End the interaction, or the waiting, with a person who is gone."""
        if now - self._usable > self.config.gone:
            self._leave()

    def _leave(self) -> None:
        self.tracker.end("the person is gone")
        if self.tracker.phase == WAITING:
            self.tracker.forget()
        if self.tracker.phase == CALIBRATING:
            self._lead.clear()

    def _begin(self) -> Decision:
        """Start the model some frames before the start, as it began in training."""
        if not self.body.place(np.array(self._references)):
            self.tracker.forget()
            self.trouble = (
                "positions are in 'world' coordinates: the person's own frame needs both shoulders, the waist or "
                "pelvis, and the collar or neck"
            )
            return self._rest(answers=True)
        self.trouble = ""
        self.interaction += 1
        self.counts.answered += 1
        self.carry = streaming.start(self.model)._replace(control=self.carry.control)
        return self._respond([self.body.to_person(arm) for arm in self._lead], moves=1)

    def _respond(self, samples: list[Arm], moves: int | None = None) -> Decision:
        """Take samples; of several, those that the robot had no time to follow move the model alone."""
        command = None
        for left, arm in zip(range(len(samples), 0, -1), samples, strict=True):
            before = self.carry.control
            self.carry, command = streaming.step(self.model, self.carry, arm)
            follows = left <= moves if moves is not None else bool(np.isfinite(arm).all()) or left == 1
            if not follows:
                self.carry = self.carry._replace(control=self.carry.control._replace(joints=before.joints))
        if command is None:  # the first window is not full yet
            self.carry, command = idle(self.model, self.carry, 0.0)
        return self._decide(command, tuple(samples), True, "")

    def _rest(self, answers: bool) -> Decision:
        """Bring the arm back to rest, or keep it there."""
        self.carry, command = idle(self.model, self.carry, np.inf)
        decision = self._decide(command, (), answers, self.tracker.reason if self.tracker.phase == RETURNING else "")
        if self.at_rest:
            self.tracker.rested()
        return decision

    def _decide(self, command: Command, samples: tuple[Arm, ...], answers: bool, note: str) -> Decision:
        return Decision(self.tracker.phase, self.interaction, command, samples, answers, note)
