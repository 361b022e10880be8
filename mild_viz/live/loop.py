"""The control loop: poll -> decide -> check -> send -> tell. It never raises, and nothing else runs in its thread."""

from __future__ import annotations

import gc
import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from mild_viz.live.controller import Decision, LiveController
from mild_viz.live.guard import Guard
from mild_viz.live.inputs import Input
from mild_viz.live.latency import Latency
from mild_viz.live.messages import JointCommand, Observation
from mild_viz.live.onset import INTERACTING
from mild_viz.live.outputs import Output
from mild_viz.live.priority import CONTROL, real_time
from mild_viz.robot.control.rules import fired_rules

log = logging.getLogger(__name__)

FAULT = "fault"
"""Name of the rule by which the last command is held after an error in our own program."""

LOGGED = 20
"""Faults whose traceback is logged; one that comes with every tick must not fill a disk."""

LAST_REST = 5.0
"""How long the arm may take back to rest when the program ends [s]."""


@dataclass(frozen=True, eq=False)
class Tick:
    """What happened in one turn of the loop."""

    time: float
    """`time.perf_counter()` [s]: what the decision was made at."""
    seen: Observation | None
    decision: Decision | None
    sent: JointCommand | None
    computing: float
    """From the frame's being taken up to the command's being handed over [s]."""
    whole: float
    """From the frame's arrival [s]; NaN without one."""
    fault: str = ""


Witness = Callable[[Tick], None]
"""Whoever is told of every tick, in the control thread: must neither wait nor raise."""


@dataclass
class LiveLoop:
    """Everything that the control thread touches."""

    controller: LiveController
    source: Input
    output: Output
    guard: Guard
    witnesses: tuple[Witness, ...] = ()
    latency: Latency = field(default_factory=Latency)
    faults: int = 0
    last_fault: str = ""
    sent: int = 0
    """Commands that left; the last one's sequence number."""
    last: JointCommand | None = None
    """The last one."""

    def run(self, stopped: Callable[[], bool], duration: float | None = None) -> None:
        """Control until stopped, until the input ends, or for so long [s]; then bring the arm back to rest."""
        config, period = self.controller.config, 1.0 / self.controller.model.rate
        # A frame may be late: a command without one comes only when it is missed.
        patience = max(config.bridge, 1.5 * period)
        ending: float | None = None
        with steady():
            began = time.perf_counter()
            due = began + patience
            while True:
                now = time.perf_counter()
                if ending is None and (
                    stopped() or self.source.finished or (duration is not None and now - began >= duration)
                ):
                    ending = now
                    self._safely(self.controller.stop)
                if ending is not None and (self.controller.at_rest or now - ending > LAST_REST):
                    return
                seen = self._poll(max(due - now, 0.0), None if ending is None else period)
                now = time.perf_counter()
                if seen is not None or now >= due:
                    sent = self._turn(seen, now)
                    if sent or seen is None:
                        due = now + (patience if seen is not None else period)
                    tidy(self.controller.tracker.phase)

    def _poll(self, timeout: float, ending: float | None) -> Observation | None:
        if ending is not None or self.source.finished:  # the arm goes to rest, whoever still sends
            time.sleep(min(timeout, ending or timeout))
            return None
        try:
            return self.source.poll(timeout)
        except Exception as error:  # whatever an input does, control goes on
            self._note(error)
            time.sleep(min(timeout, 0.01))
            return None

    def _turn(self, seen: Observation | None, now: float) -> bool:
        """One decision and what follows from it; whether a command was sent."""
        decision, fault = None, ""
        try:
            controller = self.controller
            decision = controller.tick(now) if seen is None else controller.observe(seen, now)
        except Exception as error:
            fault = self._note(error)
        sent = None
        if decision is not None or fault:
            sent = self._command(seen, decision, now)
            try:
                self.output.send(sent)
            except Exception as error:  # an output must not, but a robot must not pay for it
                fault = self._note(error)
        done = time.perf_counter()
        whole = np.nan
        if seen is not None and sent is not None:
            whole = done - seen.received
            self.latency.add(done - now, whole)
        tick = Tick(now, seen, decision, sent, done - now, whole, fault)
        for witness in self.witnesses:
            try:
                witness(tick)
            except Exception as error:
                self._note(error)
        return sent is not None

    def _command(self, seen: Observation | None, decision: Decision | None, now: float) -> JointCommand:
        """The command that leaves: as decided and checked, or the last one again."""
        positions: Float[np.ndarray, " J"] = self.guard.last
        stiffness, contact = np.ones(len(positions)), False
        phase, fired = self.controller.tracker.phase, (FAULT,)
        if decision is not None:
            command = decision.command
            positions, stiffness, contact = command.joints_commanded, command.stiffness, command.contact
            phase, fired = decision.phase, tuple(rule.name for rule in fired_rules(command.fired))
        elif self.last is not None:
            stiffness, contact = self.last.stiffness, self.last.contact
        positions, stiffness = self.guard.check(positions, stiffness, now)
        self.sent += 1
        self.last = JointCommand(
            timestamp=time.time(),
            sequence=self.sent,
            observed=None if seen is None or fired == (FAULT,) else seen.timestamp,
            joint_names=self.controller.model.robot.chain.joint_names,
            positions=positions,
            stiffness=stiffness,
            phase=phase,
            contact=contact,
            fired=fired,
        )
        return self.last

    def _safely(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            self._note(error)

    def _note(self, error: Exception) -> str:
        self.faults += 1
        self.last_fault = f"{type(error).__name__}: {error}"
        if self.faults <= LOGGED:
            log.exception("a fault in the control loop; the last command is held")
        return self.last_fault


_collected = False


def tidy(phase: str) -> None:
    """Collect garbage once after each interaction, while nobody waits for an answer."""
    global _collected
    if phase == INTERACTING:
        _collected = False
    elif not _collected:
        _collected = True
        gc.collect()


SWITCH = 5e-4
"""For how long another thread of this process may keep the interpreter while the control thread wants it [s]."""


@contextmanager
def steady() -> Iterator[None]:
    """As few pauses as possible: no garbage collection of its own accord (what is loaded is put aside for good, so that
    a collection is short), short turns of other threads, and priority where it is granted."""
    gc.collect()
    gc.freeze()
    gc.disable()
    interval = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH)
    try:
        with real_time(CONTROL):
            yield
    finally:
        sys.setswitchinterval(interval)
        gc.enable()
        gc.unfreeze()
