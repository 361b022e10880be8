"""Errors in metres: where the hand was predicted to be, and how near the hands come in contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.errors import UserError
from mild_viz.evaluation.passes import Pass
from mild_viz.pipeline import control, infer
from mild_viz.robot.contact import contact_frames
from mild_viz.robot.model import RobotModel
from mild_viz.settings import ControlSettings
from mild_viz.trial import WRIST, Trial

COMPARED = ("mild", "mild-ik")
"""Controllers whose distance in contact is measured: without inverse kinematics, and with it."""


@dataclass(frozen=True)
class HandError:
    """Distance of the predicted hand from the true one over W windows [m]."""

    n_windows: int
    mean: float
    std: float
    median: float
    worst: float
    """90th percentile."""


@dataclass(frozen=True)
class ContactDistance:
    """Mean distance between the robot's hand and the human's in frames of contact [m]."""

    n_frames: int
    controllers: Mapping[str, float]
    """By controller, in the order of `COMPARED`."""
    truth: float | None
    """The same of the recorded (retargeted) motion: what the placement alone leaves; None where it is unknown."""


def hand_error(passes: Sequence[Pass], robot: RobotModel | None) -> HandError | None:
    """Error of the hand in the first predicted frame; None where no window is complete.

    With a robot, the end effector of decoded joints against that of the true ones, by forward kinematics. Without,
    the second human's wrist, in that person's own frame.

    Raises:
        UserError: if the model drives a robot and none is given.
    """
    distances = [_hand_distance(one, robot) for one in passes if one.known.any()]
    if not distances:
        return None
    pooled = np.concatenate(distances)
    return HandError(
        n_windows=len(pooled),
        mean=float(pooled.mean()),
        std=float(pooled.std()),
        median=float(np.median(pooled)),
        worst=float(np.quantile(pooled, 0.9)),
    )


def _hand_distance(one: Pass, robot: RobotModel | None) -> Float[np.ndarray, " K"]:
    predicted, truth = (one.first_frame(windows[one.known]) for windows in (one.predicted, one.truth))
    if one.human_human:
        first = 3 * one.trial.points.index(WRIST)
        return np.linalg.norm((predicted - truth)[:, first : first + 3], axis=1)
    if robot is None:
        raise UserError(f"trial {one.trial.name}: the description of the robot is needed for its end effector")
    return np.linalg.norm(robot.end_effector(predicted) - robot.end_effector(truth), axis=1)


def contact_distance(
    checkpoint: Checkpoint, robot: RobotModel, variant: str, trials: Sequence[Trial]
) -> ContactDistance | None:
    """Distance of the hands while the recorded partners touch (`robot.contact.contact_frames`), for each controller.

    Frames of contact are those of the recording, not the model's contact states. None where there is none.
    """
    distances: dict[str, list[np.ndarray]] = {controller: [] for controller in COMPARED}
    truth = []
    for trial in trials:
        touching = contact_frames(trial)
        if not touching.any():
            continue
        inference = infer(checkpoint, trial, variant, robot)
        frames = np.rint(inference.time * trial.rate).astype(int)
        for controller in COMPARED:
            rollout = control(inference, checkpoint, robot, trial, ControlSettings(controller=controller))
            use = touching[frames] & np.isfinite(rollout.hand_distance)
            distances[controller].append(rollout.hand_distance[use])
            if controller == COMPARED[0]:
                known = use & np.isfinite(inference.joints_truth).all(1)
                hand = robot.end_effector(inference.joints_truth[known])
                truth.append(np.linalg.norm(hand - rollout.target[known], axis=1))
    pooled = {controller: np.concatenate(parts) for controller, parts in distances.items() if parts}
    if not pooled or not len(pooled[COMPARED[0]]):
        return None
    true = np.concatenate(truth)
    return ContactDistance(
        n_frames=len(pooled[COMPARED[0]]),
        controllers={controller: float(parts.mean()) for controller, parts in pooled.items()},
        truth=float(true.mean()) if len(true) else None,
    )
