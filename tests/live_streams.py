"""Frames of a trial as a sender would send them, and everything that live operation needs, for tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.skeletons import ARM_JOINTS
from mild_viz.live.config import LiveConfig
from mild_viz.live.inputs import Input
from mild_viz.live.messages import JointCommand, Observation
from mild_viz.live.outputs import Output
from mild_viz.live.replay import recorded_joints
from mild_viz.live.setup import live_model
from mild_viz.paths import default_checkpoint
from mild_viz.robot.model import load_robot
from mild_viz.settings import ControlSettings
from mild_viz.streaming import StreamModel
from mild_viz.trial import Trial

RATE = 30.0


def demo_model(variant: str = "v3.1", config: LiveConfig | None = None, **settings: object) -> StreamModel:
    """The demo model's handshake on Pepper."""
    checkpoint, robot = load_checkpoint(default_checkpoint("demo")), load_robot("pepper")
    chosen = ControlSettings(**settings)  # pyright: ignore[reportArgumentType]
    return live_model(checkpoint, variant, "handshake", robot, chosen, config or LiveConfig())


def observe(
    arm: np.ndarray, frame: int, *, names: tuple[str, ...] = ARM_JOINTS, coordinates: str = "person",
    clock: float = 0.0, period: float = 1.0 / RATE,
) -> Observation:  # fmt: skip
    """One frame that arrives on time."""
    return Observation(clock + frame * period, frame * period, frame, "test", names, arm, coordinates)


def stream(trial: Trial, *, whole: bool = False, rest: int = 0) -> list[Observation]:
    """All frames of a trial, after some of rest."""
    names, body = recorded_joints(trial) if whole else (ARM_JOINTS, trial.human_arm)
    body = np.concatenate([np.repeat(body[:1], rest, axis=0), body])
    return [observe(positions, frame, names=names) for frame, positions in enumerate(body)]


class ListInput(Input):
    """Plays observations one after the other, each `pause` [s] after the last; a callable entry is called instead."""

    def __init__(self, frames: Iterable[Observation | Callable[[], object] | None], pause: float = 0.0) -> None:
        super().__init__("list")
        self._frames, self._pause = list(frames), pause

    def poll(self, timeout: float) -> Observation | None:
        if not self._frames:
            self.finished = True
            return None
        frame = self._frames.pop(0)
        if callable(frame):
            frame()
            return None
        if frame is None:
            time.sleep(max(timeout, 0.0))
            return None
        time.sleep(self._pause)
        self.counts.received += 1
        self.counts.delivered += 1
        return Observation(**{**vars(frame), "received": time.perf_counter()})


@dataclass
class ListOutput(Output):
    """Keeps what it is sent."""

    sent: list[JointCommand] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__("list", ())

    def send(self, command: JointCommand) -> None:
        self.sent.append(command)
        self.counts.sent += 1

    def close(self) -> None:
        pass
