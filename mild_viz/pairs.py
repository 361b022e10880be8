"""What a model learns from: per trial the robot's true motion, and human and partner windows in pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.data.windows import fill_gaps, human_features, max_gap, pair_windows
from mild_viz.errors import UserError
from mild_viz.robot.contact import upright
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.robot.retarget import retarget_pepper
from mild_viz.robot.retarget_arm import retarget_arm
from mild_viz.robot.robots import ROBOTS
from mild_viz.trial import Trial


@dataclass(frozen=True, eq=False)
class Windows:
    """Paired windows of several trials. Row r is human window `step[r]` of trial `trial[r]`.

    A row with a frame that could not be filled is NaN throughout, and stays in place so that a trial's
    rows are consecutive in time.
    """

    human: Float[np.ndarray, "R X"]
    partner: Float[np.ndarray, "R Y"]
    trial: Int[np.ndarray, " R"]
    step: Int[np.ndarray, " R"]
    actions: tuple[str, ...]
    """Action of each trial."""

    @property
    def complete(self) -> Bool[np.ndarray, " R"]:
        """Rows without a gap: those that a loss or an error can be taken on."""
        return np.logical_and.reduce(np.isfinite(np.concatenate([self.human, self.partner], axis=1)), axis=1)

    def rows(self, trial: int) -> slice:
        """The rows of one trial."""
        first, last = np.searchsorted(self.trial, [trial, trial + 1])
        return slice(int(first), int(last))


def robot_truth(trial: Trial, joint_names: Sequence[str]) -> Float[np.ndarray, "T J"]:
    """The robot's joints that a trial shows: recorded, or retargeted from the partner's arm to a known robot.

    NaN where the partner was not tracked for longer than a gap that is filled.

    Raises:
        UserError: if the trial shows no motion for these joints.
    """
    if trial.robot_joints is not None and tuple(trial.robot_joint_names) == tuple(joint_names):
        return trial.robot_joints
    robot = next((name for name, spec in ROBOTS.items() if spec.joint_names == tuple(joint_names)), None)
    if trial.partner_arm is None or robot is None:
        raise UserError(
            f"trial {trial.name} has no motion for the joints {', '.join(joint_names)}; "
            f"it has {', '.join(trial.robot_joint_names) or 'no recorded robot'}"
        )
    return retargeted_truth(trial, _robot(robot))


@cache
def _robot(name: str) -> RobotModel:
    return load_robot(name)


def retargeted_truth(trial: Trial, robot: RobotModel) -> Float[np.ndarray, "T J"]:
    """The second human's motion as a robot would make it [rad], NaN where there is none.

    Where the partner's heading in the world is known, the robot stands upright with that heading.
    """
    if trial.partner_arm is None:
        return np.full((trial.n_frames, robot.chain.n_joints), np.nan)
    arm = fill_gaps(trial.partner_arm, max_gap(trial.rate))
    world = trial.T_world_partner
    return retarget(robot, arm, trial.rate, None if world is None else upright(world) @ world[:3, :3])


def retarget(
    robot: RobotModel,
    arm: Float[np.ndarray, "T 3 3"],
    rate: float,
    rotation: Float[np.ndarray, "3 3"] | None = None,
    *,
    length: Float[np.ndarray, " T"] | None = None,
    previous: Float[np.ndarray, " J"] | None = None,
) -> Float[np.ndarray, "T J"]:
    """Joints [rad] of a robot that moves as a person's right arm (shoulder, elbow, wrist [m]) at `rate` [Hz].

    The robot's own rule says how (`ArmSpec.retarget`): Pepper's arm takes over the angles of the person's, every other
    one the place of the hand, by `robot.retarget_arm`, which says what the other arguments are.
    """
    if robot.spec.main.retarget == "pepper-angles":
        return retarget_pepper(arm)
    return retarget_arm(robot.chain, arm, rate, rotation, length=length, previous=previous)


def window_errors(
    predicted: Float[np.ndarray, "R Y"], truth: Float[np.ndarray, "R Y"], human_human: bool
) -> Float[np.ndarray, " R"]:
    """Mean squared error of every window: of a robot's joints [rad^2], or of a second human's points [m^2].

    Between humans the squared error is summed over xyz, and averaged over positions and velocities and 5 frames.
    """
    squared = (predicted - truth) ** 2
    if human_human:
        return squared.reshape(len(squared), -1, 3).sum(2).mean(1)
    return squared.mean(1)


def check_rate(rate: float | None, model: str, trials: Sequence[Trial]) -> None:
    """Refuse trials of another rate than a model's: windows of 5 observations would span another time.

    Args:
        rate: Frames a second of what the model was trained on [Hz]; None where that is not known.
        model: The model's name, for the message.
        trials: What it is to be run on.

    Raises:
        UserError: naming both rates and the first such trial.
    """
    for trial in trials:
        if rates_differ(rate, trial.rate):
            raise UserError(
                f"checkpoint {model} was trained on {rate:g} Hz, trial {trial.name} has {trial.rate:g} Hz; "
                f"valid: a dataset of {rate:g} Hz, or a model trained on this one"
            )


def check_points(points: Sequence[str], model: str, trials: Sequence[Trial]) -> None:
    """Refuse trials that show a model other points of the human than it was trained on. Raises `UserError`."""
    for trial in trials:
        if tuple(trial.points) != tuple(points):
            raise UserError(
                f"checkpoint {model} reads {', '.join(points)} of the human, trial {trial.name} gives "
                f"{', '.join(trial.points)}; valid: a dataset that gives {', '.join(points)}"
            )


def rates_differ(rate: float | None, other: float) -> bool:
    """Whether a rate [Hz] is another one than a model's; clocks are not exact, and a model may not know its own."""
    return rate is not None and not abs(other - rate) <= 0.01 * rate


def stack_windows(trials: Sequence[Trial], joint_names: Sequence[str] | None) -> Windows:
    """Windows of all trials; the partner is the robot with `joint_names`, or the second human if None."""
    humans, partners, indices, steps = [], [], [], []
    for index, trial in enumerate(trials):
        points, others = fill_gaps(trial.human_points, max_gap(trial.rate)), trial.partner_points
        if joint_names is not None:
            truth = robot_truth(trial, joint_names)
        elif others is not None:
            truth = human_features(fill_gaps(others, max_gap(trial.rate)))
        else:
            raise UserError(f"trial {trial.name} has no second human")
        human, partner = pair_windows(points, truth)
        humans.append(human)
        partners.append(partner)
        indices.append(np.full(len(human), index))
        steps.append(np.arange(len(human)))
    return Windows(
        np.concatenate(humans),
        np.concatenate(partners),
        np.concatenate(indices),
        np.concatenate(steps),
        tuple(trial.action for trial in trials),
    )
