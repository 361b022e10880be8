"""The live state: widgets -> one immutable `Choice` -> pipeline -> one immutable `Rollout` -> views.

Callbacks only call `mark_dirty`. One worker thread reads the widgets, reruns what depends on what changed, and hands
the new rollout over whole; while it works, any number of further changes count as one. A failing rerun reports its
message and leaves the last good rollout standing.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from mild_viz.checkpoint import Checkpoint
from mild_viz.dashboard.view import ViewSettings
from mild_viz.errors import UserError
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import ControlSettings, Settings
from mild_viz.trial import Trial

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Choice:
    """What the widgets say, and the model and trial that they name."""

    settings: Settings
    view: ViewSettings
    checkpoint: Checkpoint
    """Compared by identity: a checkpoint is loaded once."""
    trial: Trial
    robot: RobotModel
    """Compared by identity: a robot is loaded once."""

    def same_inference(self, other: Choice) -> bool:
        """Whether `infer` would give the same: model, variant, trial and robot."""
        same_model = self.checkpoint.human_vae is other.checkpoint.human_vae and self.robot is other.robot
        return self.settings.infer == other.settings.infer and same_model


@dataclass(frozen=True)
class Pipeline:
    """The two stages that a session reruns: those of `mild_viz.pipeline`."""

    infer: Callable[[Checkpoint, Trial, str, RobotModel], Inference]
    control: Callable[[Inference, Checkpoint, RobotModel, Trial, ControlSettings], Rollout]


class Session:
    """Keeps the rollout that is shown equal to what the widgets say.

    `show(rollout, choice, is_new_trial)` is called from the worker after every successful rerun or change of view;
    `report(message)` after a failure, and with None after the first success since. `finish(rollout, choice, is_stale)`
    is for what takes longer and comes after the rollout is shown; where `is_stale()` says that a newer choice waits, it
    returns False, and is asked again.
    """

    def __init__(
        self,
        read: Callable[[], Choice],
        pipeline: Pipeline,
        show: Callable[[Rollout, Choice, bool], None],
        report: Callable[[str | None], None],
        finish: Callable[[Rollout, Choice, Callable[[], bool]], bool] = lambda rollout, choice, is_stale: True,
    ) -> None:
        self._read, self._pipeline, self._show, self._report = read, pipeline, show, report
        self._finish, self._finished = finish, True
        self._dirty = threading.Event()
        self._idle = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="mild_viz session", daemon=True)
        self.choice: Choice | None = None
        """What is shown (the last good choice)."""
        self.rollout: Rollout | None = None
        """What is shown (the last good rollout)."""
        self.n_infer = 0
        self.n_control = 0
        self.n_shown = 0
        self.error: str | None = None
        """The message of the last rerun, if it failed."""

    def start(self) -> None:
        """Start the worker; the first rollout is on its way."""
        self.mark_dirty()
        self._thread.start()

    def mark_dirty(self) -> None:
        """Say that a widget changed. Cheap, never blocks: this is all that a callback does."""
        self._idle.clear()
        self._dirty.set()

    def wait_idle(self, timeout: float = 60.0) -> bool:
        """Wait until nothing is left to do. True if that came to pass in time."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            if self._idle.wait(max(deadline - time.monotonic(), 0.0)) and not self._dirty.is_set():
                return True
        return False

    def close(self) -> None:
        """Stop the worker after the stage it is in."""
        self._closed = True
        self._dirty.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout=10.0)

    def _work(self) -> None:
        while True:
            self._dirty.wait()
            self._dirty.clear()
            if self._closed:
                return
            try:
                self._update()
            except UserError as error:
                self._fail(str(error))
            except Exception as error:  # whatever it is, the page must say so and go on
                log.exception("the session's rerun failed")
                self._fail(f"{type(error).__name__}: {error}")
            else:
                if self.error is not None:
                    self.error = None
                    self._report(None)
            if not self._dirty.is_set():
                self._idle.set()
                if self._dirty.is_set():
                    self._idle.clear()

    def _fail(self, message: str) -> None:
        self.error = message
        try:
            self._report(message)
        except Exception:
            log.exception("the message could not be shown: %s", message)

    def _update(self) -> None:
        choice = self._read()
        shown, rollout = self.choice, self.rollout
        if shown is None or rollout is None or not choice.same_inference(shown):
            inference, choice = self._infer(choice)
        else:
            inference = rollout.inference
        is_new = rollout is None or inference is not rollout.inference
        if is_new or shown is None or rollout is None or choice.settings.control != shown.settings.control:
            self.n_control += 1
            rollout = self._pipeline.control(
                inference, choice.checkpoint, choice.robot, choice.trial, choice.settings.control
            )
        elif choice.view == shown.view:
            self._complete(rollout, choice)
            return
        self._show(rollout, choice, is_new)
        # Only now, when it is on the page: after a failure above, the same choice is tried again.
        self.rollout, self.choice = rollout, choice
        self.n_shown += 1
        self._finished = False
        self._complete(rollout, choice)

    def _complete(self, rollout: Rollout, choice: Choice) -> None:
        """The last stage, unless it is done or a newer choice waits."""
        if not self._finished and not self._dirty.is_set():
            self._finished = self._finish(rollout, choice, self._dirty.is_set)

    def _infer(self, choice: Choice) -> tuple[Inference, Choice]:
        """Infer for the latest choice: what was chosen in the meantime decides the control that follows."""
        while True:
            self.n_infer += 1
            inference = self._pipeline.infer(
                choice.checkpoint, choice.trial, choice.settings.infer.variant, choice.robot
            )
            if not self._dirty.is_set() or self._closed:
                return inference, choice
            self._dirty.clear()
            latest = self._read()
            if latest.same_inference(choice):
                return inference, latest
            choice = latest
