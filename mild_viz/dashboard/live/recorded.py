"""A recorded session on the page of playback: exactly as it was, until a person asks for other settings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from mild_viz import pipeline
from mild_viz.checkpoint import Checkpoint
from mild_viz.live.loop import Tick
from mild_viz.live.replayed import (
    interactions,
    recorded_rollout,
    session_checkpoint,
    session_dataset,
    session_robot,
    session_settings,
)
from mild_viz.live.session import Session, read_session
from mild_viz.pipeline import with_contact_states
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import ControlSettings
from mild_viz.trial import Dataset, Trial


@dataclass
class RecordedSession:
    """The two stages of the page's session: what was recorded for the recorded settings, else the pipeline."""

    session: Session
    checkpoint: Checkpoint
    robot: RobotModel
    """Before the page has its own, of the same name."""
    settings: ControlSettings
    """The recorded ones, with the contact states."""
    _as_recorded: ControlSettings | None = None
    """What the widgets read as until a person moves one: they stand for the recorded settings."""
    _rollouts: dict[int, Rollout] = field(default_factory=dict)

    @cached_property
    def dataset(self) -> Dataset:
        """Its interactions as trials."""
        return session_dataset(self.session)

    @cached_property
    def _interactions(self) -> tuple[tuple[Tick, ...], ...]:
        return tuple(interactions(self.session).values())

    @property
    def variant(self) -> str:
        """The variant that ran."""
        return self.session.header["variant"]

    @property
    def action(self) -> str:
        """The action that ran."""
        return self.session.header["action"]

    def infer(self, checkpoint: Checkpoint, trial: Trial, variant: str, robot: RobotModel) -> Inference:
        """What the model said, or what another one says."""
        if self._is_recorded(checkpoint, trial, variant, robot):
            return self._rollout(trial.index).inference
        return pipeline.infer(checkpoint, trial, variant, robot)

    def control(
        self, inference: Inference, checkpoint: Checkpoint, robot: RobotModel, trial: Trial, settings: ControlSettings
    ) -> Rollout:
        """What was sent, or what other settings make of it."""
        if self._as_recorded is None:  # whatever variant is shown first: nobody has moved a widget yet
            self._as_recorded = replace(settings, contact_states=self.settings.contact_states)
        if self._is_recorded(checkpoint, trial, inference.variant, robot):
            recorded = self._rollout(trial.index)
            if settings == self._as_recorded:
                return recorded
            # No widget stands for the placement before it is moved.
            settings = replace(settings, placement=settings.placement or recorded.placement)
            if inference is recorded.inference:  # it has a row for every command, a rerun one for every frame
                inference = pipeline.infer(checkpoint, trial, inference.variant, robot)
        return pipeline.control(inference, checkpoint, robot, trial, settings)

    def _is_recorded(self, checkpoint: Checkpoint, trial: Trial, variant: str, robot: RobotModel) -> bool:
        same_model = checkpoint.path.resolve() == self.checkpoint.path.resolve() and variant == self.variant
        return trial.dataset == self.dataset.name and same_model and robot is self.robot

    def _rollout(self, index: int) -> Rollout:
        if index not in self._rollouts:
            ticks = self._interactions[index]
            self._rollouts[index] = recorded_rollout(self.session, ticks, index, self.checkpoint, self.robot)
        return self._rollouts[index]


def open_recorded(path: Path, checkpoint: Path | None = None) -> RecordedSession:
    """A session's file, its model (from where it lay, or from `checkpoint`) and its robot.

    Raises:
        UserError: if one of them cannot be read, the model is another one, or there was no interaction.
    """
    session = read_session(path)
    model = session_checkpoint(session, checkpoint)
    header = session.header
    settings = with_contact_states(session_settings(session), model, header["variant"], header["action"])
    recorded = RecordedSession(session, model, session_robot(session, model), settings)
    _ = recorded.dataset  # its own error, before a page opens
    return recorded
