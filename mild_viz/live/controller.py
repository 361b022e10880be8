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
from mild_viz.live.messages import Observation
from mild_viz.live.onset import CALIBRATING, INTERACTING, RETURNING, WAITING, PhaseTracker
from mild_viz.live.pace import Clock, Pace
from mild_viz.live.person import Body
from mild_viz.robot.control.rules import GONE, MISSING
from mild_viz.streaming import Command, StreamModel

Arm = Float[np.ndarray, "3 3"]

AT_REST = 0.01
"""The arm is back when no joint is farther from its resting place [rad]."""

STOPPED = "the program ends"
"""Why an interaction ends that nobody but `stop` has ended: a session that is run again knows it by this note."""

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
    T_world_person: Float[np.ndarray, "4 4"] | None = None
    """The person's frame, where it had to be found in positions given in world."""


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
        self._pace = Pace(self.model.rate, config.bridge, config.gone_after)
        self._lead: deque[Arm] = deque(maxlen=config.lead_frames(self.model.rate))
        self._references: deque[Float[np.ndarray, "4 3"]] = deque(maxlen=REFERENCES)
        self._last: tuple[float, Arm] | None = None
        self._commanded: float | None = None
        """When the last command was made [s]."""
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
        if np.isfinite(arm).all():
            self._usable = now
        else:
            self.counts.untracked += 1
        if self._last is not None and time - self._last[0] > self.config.gone_after:
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
            return self._begin(now)
        if not samples:
            return None
        self.counts.answered += 1
        if phase == INTERACTING:
            return self._respond(now, [self.body.to_person(sample) for sample in samples])
        return self._rest(now, answers=True)

    def tick(self, now: float) -> Decision:
        """Decide without an observation, because none came in time."""
        self.counts.held += 1
        self._give_up(now)
        if self.tracker.phase != INTERACTING:
            return self._rest(now, answers=False)
        self.carry, command = streaming.idle(self.model, self.carry, self._elapsed(now))
        return self._decide(now, command, (), False, "no frame came")

    def stop(self) -> None:
        """End the interaction, because the program ends."""
        self.tracker.end(STOPPED)

    @property
    def at_rest(self) -> bool:
        """Whether the last command was the resting posture."""
        joints, rest = self.carry.control.joints, self.model.controller.limits.rest
        return bool(np.abs(joints - rest).max() <= AT_REST)

    def _give_up(self, now: float) -> None:
        """End the interaction, or the waiting, with a person who is gone."""
        if now - self._usable > self.config.gone_after:
            self._leave()

    def _leave(self) -> None:
        self.tracker.end("the person is gone")
        if self.tracker.phase == WAITING:
            self.tracker.forget()
        if self.tracker.phase == CALIBRATING:
            self._lead.clear()

    def _begin(self, now: float) -> Decision:
        """Start the model some frames before the start, as it began in training."""
        self.counts.answered += 1
        if not self.body.place(np.array(self._references)):
            self.tracker.forget()
            self.trouble = (
                "positions are in 'world' coordinates: the person's own frame needs both shoulders, the waist or "
                "pelvis, and the collar or neck"
            )
            return self._rest(now, answers=True)
        self.trouble = ""
        self.interaction += 1
        self.carry = streaming.start(self.model)._replace(control=self.carry.control)
        return self._respond(now, [self.body.to_person(arm) for arm in self._lead])

    def _respond(self, now: float, samples: list[Arm]) -> Decision:
        """Take samples. The last one makes the command; those before it move the model alone, since the robot had no
        time to follow them."""
        seconds = self._elapsed(now)
        for arm in samples[:-1]:
            before = self.carry.control
            self.carry, _ = streaming.step(self.model, self.carry, arm)
            self.carry = self.carry._replace(control=self.carry.control.paused(before))
        self.carry, command = streaming.step(self.model, self.carry, samples[-1], seconds)
        assert command is not None, "the lead fills the first window"
        return self._decide(now, command, tuple(samples), True)

    def _rest(self, now: float, answers: bool) -> Decision:
        """Bring the arm back to rest, or keep it there."""
        self.carry = self.carry._replace(control=self.carry.control.dismissed())
        self.carry, command = streaming.idle(self.model, self.carry, self._elapsed(now))
        if now - self._usable <= self.config.gone_after:  # sent to rest, but not because nobody is there
            command = command._replace(fired=command.fired & ~(1 << MISSING | 1 << GONE))
        note = self.tracker.reason if self.tracker.phase == RETURNING else ""
        decision = self._decide(now, command, (), answers, note)
        if self.at_rest:
            self.tracker.rested()
        return decision

    def _elapsed(self, now: float) -> float:
        """Time since the last command [s]; a period before the first."""
        return 1.0 / self.model.rate if self._commanded is None else now - self._commanded

    def _decide(
        self, now: float, command: Command, samples: tuple[Arm, ...], answers: bool, note: str = ""
    ) -> Decision:
        self._commanded = now
        found = self.body.T_world_person if self.body.coordinates == "world" else None
        return Decision(self.tracker.phase, self.interaction, command, samples, answers, note, found)
