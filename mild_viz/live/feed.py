"""What the page is told: a snapshot now and then, through a socket that refuses what does not fit. Nobody waits."""

from __future__ import annotations

import contextlib
import errno
import pickle
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from mild_viz.live.controller import Decision
from mild_viz.live.latency import NONE, SHOWN, Times
from mild_viz.live.loop import LiveLoop, Tick
from mild_viz.live.messages import JointCommand

LARGEST = 60_000
"""A snapshot is one message of a few kB; longer ones would not be taken whole everywhere."""

STATUS_PERIOD = 0.5
"""Time between two updates of the figures that take longer to make [s]."""


@dataclass(frozen=True, eq=False)
class Figures:
    """What changes slowly."""

    computing: Times = NONE
    whole: Times = NONE
    rate_in: float = 0.0
    """Frames a second that arrive [Hz]."""
    rate_out: float = 0.0
    """Commands a second [Hz]."""
    input_counts: dict[str, Any] | None = None
    counts: dict[str, int] | None = None
    output_counts: dict[str, Any] | None = None
    clock_jumps: int = 0
    refused: int = 0
    faults: int = 0
    last_fault: str = ""
    troubles: tuple[str, ...] = ()
    recorded: int | None = None
    """Turns in the session's file; None where none is written."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """One moment, as the page shows it. Positions [m] are in the person's own frame, joints [rad]."""

    number: int
    time: float
    phase: str
    interaction: int
    note: str
    displacement: float
    answers: bool
    names: tuple[str, ...]
    positions: Float[np.ndarray, "K 3"] | None
    arm: Float[np.ndarray, "3 3"]
    commanded: Float[np.ndarray, " J"]
    decoded: Float[np.ndarray, " J"]
    stiffness: float
    contact: bool
    fired: tuple[str, ...]
    log_alpha: Float[np.ndarray, " S"]
    human_latent: Float[np.ndarray, " D"]
    robot_latent: Float[np.ndarray, " D"]
    figures: Figures


def channel() -> tuple[socket.socket, socket.socket]:
    """Both ends of a channel that keeps messages whole, between this process and a child."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ours.setblocking(False)
    return ours, theirs


class Feed:
    """A witness of the control loop that tells the page."""

    def __init__(self, loop: LiveLoop, end: socket.socket, rate: float, recorder: Any = None) -> None:
        self._loop, self._end, self._period, self._recorder = loop, end, 1.0 / rate, recorder
        self._due = self._status_due = 0.0
        self._number = 0
        self._figures = Figures()
        self._before: tuple[float, int, int] | None = None
        self._decision: Decision | None = None
        """The last one: what the model says is as it was then, where a fault leaves none."""
        self.dropped = 0
        """Snapshots that the page did not take in time."""
        self.gone = False
        """Whether the page's process is no more."""

    def __call__(self, tick: Tick) -> None:
        """Tell the page, if it is time. Neither waits nor raises, whatever became of the page."""
        self._decision = tick.decision or self._decision
        if self.gone or self._decision is None or tick.sent is None or tick.time < self._due:
            return
        self._due = max(self._due + self._period, tick.time)
        if tick.time >= self._status_due:
            self._status_due = tick.time + STATUS_PERIOD
            self._figures = self._look(tick.time)
        self._number += 1
        try:
            self._end.send(pickle.dumps(self._snapshot(tick, self._decision, tick.sent), protocol=5))
        except (BlockingIOError, InterruptedError):
            self.dropped += 1
        except OSError as error:
            if error.errno == errno.ENOBUFS:  # where a full channel is called so
                self.dropped += 1
            else:
                self.gone = True

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._end.close()

    def _snapshot(self, tick: Tick, decision: Decision, sent: JointCommand) -> Snapshot:
        command, seen, controller = decision.command, tick.seen, self._loop.controller
        return Snapshot(
            number=self._number,
            time=tick.time,
            phase=sent.phase,
            interaction=decision.interaction,
            note=decision.note,
            displacement=controller.tracker.displacement,
            answers=sent.observed is not None,
            names=() if seen is None else seen.names,
            positions=None if seen is None else controller.body.to_person(seen.positions),
            arm=controller.arm,
            commanded=sent.positions,
            decoded=command.joints_decoded,
            stiffness=float(sent.stiffness.min()),
            contact=sent.contact,
            fired=sent.fired,
            log_alpha=command.log_alpha,
            human_latent=command.human_latent_mean,
            robot_latent=command.robot_latent_mean,
            figures=self._figures,
        )

    def _look(self, now: float) -> Figures:
        loop = self._loop
        received, sent = loop.source.counts.received, loop.sent
        rates = (0.0, 0.0)
        if self._before is not None and now > self._before[0]:
            passed = now - self._before[0]
            rates = ((received - self._before[1]) / passed, (sent - self._before[2]) / passed)
        self._before = (now, received, sent)
        recorder = self._recorder
        troubles = (loop.source.trouble, loop.output.trouble, loop.controller.trouble, getattr(recorder, "trouble", ""))
        return Figures(
            computing=loop.latency.computing(SHOWN),
            whole=loop.latency.whole(SHOWN),
            rate_in=rates[0],
            rate_out=rates[1],
            input_counts=dict(vars(loop.source.counts)),
            counts=dict(vars(loop.controller.counts)),
            output_counts=dict(vars(loop.output.counts)),
            clock_jumps=loop.controller.clock.jumps,
            refused=loop.guard.refused,
            faults=loop.faults,
            last_fault=loop.last_fault,
            troubles=tuple(trouble for trouble in troubles if trouble),
            recorded=None if recorder is None else recorder.written,
        )


def newest(end: socket.socket, timeout: float) -> Snapshot | None:
    """In the page's process: the newest snapshot that is there, or the first within `timeout` [s]."""
    end.settimeout(timeout)
    latest = None
    try:
        latest = end.recv(LARGEST)
        end.setblocking(False)
        while True:
            latest = end.recv(LARGEST)
    except (BlockingIOError, TimeoutError):
        pass
    # Our own process wrote it: nobody else has the other end.
    return None if latest is None else pickle.loads(latest)


def wait_for(end: socket.socket, alive: Callable[[], bool], timeout: float) -> str:
    """In the control process: the page's first word; what is wrong where it has none."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline and alive():
        try:
            return end.recv(LARGEST).decode()
        except BlockingIOError:
            time.sleep(0.02)
    return "the page did not start" if alive() else "the page's process ended while it started"
