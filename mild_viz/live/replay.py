"""A recorded trial in place of a tracker, in real time."""

from __future__ import annotations

import threading
import time

import numpy as np

from mild_viz.data.load import load_dataset
from mild_viz.data.skeletons import ARM_JOINTS
from mild_viz.errors import UserError
from mild_viz.live.address import Address, check_options
from mild_viz.live.inputs import Input
from mild_viz.live.messages import JOINTS, Observation
from mild_viz.trial import Trial

OPTIONS = ("rate", "speed", "loop", "rest")


class ReplayInput(Input):
    """The person of one trial, in the person's own frame; the clock starts at the first `poll`.

    Timestamps are seconds since then. `rate` [Hz] samples the recorded motion anew (linearly, lost where either
    neighbour is); `speed` makes it faster; `loop` starts it over at its end, without a pause. `rest` [s] holds the
    first frame so long before: recordings may begin with the reach, while a person who is met stands there first.
    """

    def __init__(self, address: Address) -> None:
        check_options(address, OPTIONS)
        trial = find_trial(address.place)
        super().__init__(f"replay:{trial.name}")
        self.trial = trial
        self._rate = address.number("rate", trial.rate, 1.0, 1000.0)
        speed = address.number("speed", 1.0, 0.01, 100.0)
        self._loop = address.choice("loop", ("0", "1")) == "1"
        self._names, body = recorded_joints(trial)
        self._frames = _sampled(body, trial.rate * speed / self._rate)
        n_rest = round(address.number("rest", 0.0, 0.0, 60.0) * self._rate)
        if n_rest:
            first = self._frames[int(np.isfinite(self._frames).all((1, 2)).argmax())]
            self._frames = np.concatenate([np.repeat(first[None], n_rest, axis=0), self._frames])
        self._next = 0
        self._start: float | None = None
        self._closed = threading.Event()

    def poll(self, timeout: float) -> Observation | None:
        now = time.perf_counter()
        if self._start is None:
            self._start = now
        if self.finished:
            return None
        due = self._start + self._next / self._rate
        if due > now:
            if due - now > timeout:
                self._closed.wait(max(timeout, 0.0))
                return None
            if self._closed.wait(due - now):
                return None
        # Newest wins: what should have been played meanwhile is left out.
        index = max(self._next, int((time.perf_counter() - self._start) * self._rate))
        if not self._loop:
            index = min(index, len(self._frames) - 1)
        self.counts.received += index - self._next + 1
        self.counts.skipped += index - self._next
        self.counts.delivered += 1
        self._next = index + 1
        self.finished = not self._loop and self._next == len(self._frames)
        return Observation(
            timestamp=index / self._rate,
            received=self._start + index / self._rate,
            sequence=index,
            source=self.name,
            names=self._names,
            positions=self._frames[index % len(self._frames)],
            coordinates="person",
        )

    def close(self) -> None:
        super().close()
        self._closed.set()


def find_trial(place: str) -> Trial:
    """The trial that DATASET/SPLIT/INDEX names, or DATASET/INDEX of the test split."""
    parts = place.split("/")
    if len(parts) == 2:
        parts.insert(1, "test")
    if len(parts) != 3 or not parts[2].isdecimal() or len(parts[2]) > 9:
        raise UserError(f"replay:{place} names no trial; expected: replay:DATASET/TRIAL, such as replay:nuisi/test/3")
    return load_dataset(parts[0]).trial(parts[1], int(parts[2]))


def recorded_joints(trial: Trial) -> tuple[tuple[str, ...], np.ndarray]:
    """Names and positions (T, K, 3) [m] of what frames of a trial carry: the whole body where it is known."""
    body = trial.human_skeleton
    if body is None or not set(ARM_JOINTS) <= set(body.joint_names) or not set(body.joint_names) <= set(JOINTS):
        return ARM_JOINTS, trial.human_arm
    return body.joint_names, body.positions


def _sampled(frames: np.ndarray, step: float) -> np.ndarray:
    """Frames (T, K, 3) at every `step` recorded frames, linearly between two."""
    times = np.round(np.arange(0.0, len(frames) - 1 + 1e-9, step), 9)
    before = np.minimum(times.astype(int), len(frames) - 1)
    after = np.minimum(before + 1, len(frames) - 1)
    share = (times - before)[:, None, None]
    # Exactly on a recorded frame the other one must not matter: it may be lost, and NaN times 0 is NaN.
    return np.where(share == 0, frames[before], frames[before] * (1 - share) + frames[after] * share)
