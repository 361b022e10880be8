"""What a model decodes of the partner, and the joints that a robot makes of it.

A model either decodes the joints of the robot that it was trained for, or the right arm of a second human: that moves
any robot, by the rule that retargets recordings to it (`pairs.retarget`). Or it decodes both hands of a second human,
which the two arms of a robot follow in its own task space (Sec. Bimanual Robot-to-Human Handovers).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.data.windows import fill_gaps, human_features, max_gap
from mild_viz.errors import UserError
from mild_viz.pairs import retarget, retargeted_truth, robot_truth
from mild_viz.robot.contact import arm_lengths
from mild_viz.robot.model import RobotModel, load_robot
from mild_viz.robot.objective.terms import IKTerms
from mild_viz.robot.retarget_arm import from_rest, largest_step
from mild_viz.robot.robots import robot_of
from mild_viz.robot.source import RobotSource
from mild_viz.robot.workspace import ARM_OF, HandMap, hand_map
from mild_viz.trial import ARM_POINTS, HAND_POINTS, Trial


class Truth(NamedTuple):
    """The partner's true motion; NaN where it is unknown."""

    features: Float[np.ndarray, "T F"]
    """What a model predicts of every frame: the columns of its windows."""
    joints: Float[np.ndarray, "T J"]
    """What the robot's first arm would make of it [rad]."""


class Moved(NamedTuple):
    """A robot's answer to N decoded windows."""

    joints: Float[np.ndarray, "N J"]
    """Those of its first arm in the first predicted frame [rad]."""
    partner: Float[np.ndarray, "N P 3"] | None
    """The second human's points in that frame, in that person's own frame [m]; None where joints are decoded."""
    carry: Float[np.ndarray, "_"]
    """The last joints of all arms: what the next windows go on from."""
    others: Mapping[str, Float[np.ndarray, "N _"]] = {}
    """The joints of its other arms, by name; those that are not named rest."""


@dataclass(frozen=True)
class JointDecoding:
    """The model decodes the joints of the robot that it was trained for."""

    joint_names: tuple[str, ...]
    other_arms: tuple[str, ...] = ()
    """The arms that it moves beside the first one."""

    def start(self) -> Float[np.ndarray, " J"]:
        """The carry before the first window."""
        return np.full(len(self.joint_names), np.nan)

    def move(self, decoded: Float[np.ndarray, "N Y"], carry: Float[np.ndarray, " J"]) -> Moved:
        """The joints of the first predicted frame."""
        joints = decoded[:, : len(self.joint_names)]
        return Moved(joints, None, joints[-1] if len(joints) else carry)

    def truth(self, trial: Trial) -> Truth:
        """The trial's recorded or retargeted joints. `UserError` where it has none."""
        joints = robot_truth(trial, self.joint_names)
        return Truth(joints, joints)


@dataclass(frozen=True, eq=False)
class ArmDecoding:
    """The model decodes a second human's right arm, which `robot` follows."""

    robot: RobotModel
    rate: float
    """Frames a second [Hz]."""
    other_arms: tuple[str, ...] = ()

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.robot.chain.joint_names

    def start(self) -> Float[np.ndarray, " J"]:
        """The carry before the first window: there are no joints yet."""
        return np.full(self.robot.chain.n_joints, np.nan)

    def move(self, decoded: Float[np.ndarray, "N Y"], carry: Float[np.ndarray, " J"]) -> Moved:
        """The arm of the first predicted frame, retargeted. All windows at once or one by one gives the same bits.

        The hand keeps its share of that arm's own length: no length of a person has to be known. The robot's base takes
        the place of the person's own frame, as if that stood upright: how a partner leans, nobody predicts.
        """
        partner = points_of(decoded, len(ARM_POINTS))
        joints = retarget(self.robot, partner, self.rate, length=arm_lengths(partner), previous=carry)
        return Moved(joints, partner, joints[-1] if len(joints) else carry)

    def truth(self, trial: Trial) -> Truth:
        """The recorded arm, and the joints that it is retargeted to."""
        arm = np.full((trial.n_frames, 3, 3), np.nan) if trial.partner_arm is None else trial.partner_arm
        return Truth(human_features(fill_gaps(arm, max_gap(trial.rate))), retargeted_truth(trial, self.robot))


@dataclass(frozen=True, eq=False)
class HandDecoding:
    """The model decodes both hands of a second human, which both arms of `robot` follow."""

    robot: RobotModel
    map: HandMap
    rate: float
    """Frames a second [Hz]."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.robot.chain.joint_names

    @property
    def other_arms(self) -> tuple[str, ...]:
        first = next(iter(self.robot.arms))
        return tuple(arm for arm in ARM_OF.values() if arm != first)

    def start(self) -> Float[np.ndarray, "_"]:
        """The carry before the first window: there are no joints yet."""
        return np.full(sum(self.robot.arms[arm].n_joints for arm in ARM_OF.values()), np.nan)

    def move(self, decoded: Float[np.ndarray, "N Y"], carry: Float[np.ndarray, "_"]) -> Moved:
        """Both arms' joints for the hands of the first predicted frame. All windows or one by one: the same bits."""
        hands = points_of(decoded, len(HAND_POINTS))
        joints, first = self.follow(hands, carry), next(iter(self.robot.arms))
        last = np.concatenate([rows[-1] for rows in joints.values()]) if len(hands) else carry
        return Moved(joints.pop(first), hands, last, joints)

    def truth(self, trial: Trial) -> Truth:
        """The recorded hands, and the joints that follow them."""
        hands = trial.partner_points
        hands = np.full((trial.n_frames, len(HAND_POINTS), 3), np.nan) if hands is None else hands
        hands = fill_gaps(hands, max_gap(trial.rate))
        first = next(iter(self.robot.arms))
        return Truth(human_features(hands), self.follow(hands, self.start(), (first,))[first])

    def follow(
        self,
        hands: Float[np.ndarray, "T P 3"],
        carry: Float[np.ndarray, "_"],
        arms: Collection[str] = tuple(ARM_OF.values()),
    ) -> dict[str, Float[np.ndarray, "T _"]]:
        """By arm, the joints [rad] that bring its hand to where the person's is, as the map says.

        Eq. ik-prior-simplified with the resting posture as prior, as in `robot.retarget_arm`, and no joint faster than
        there. NaN where the hands are.
        """
        targets, joints, start = self.map(hands), {}, 0
        for index, arm in enumerate(ARM_OF.values()):
            chain = self.robot.arms[arm]
            previous = carry[start : start + chain.n_joints]
            start += chain.n_joints
            if arm in arms:
                known = np.logical_and.reduce(np.isfinite(targets[:, index]), axis=1)
                terms = IKTerms(max_step=largest_step(chain, self.rate), previous=previous)
                joints[arm] = from_rest(chain, targets[:, index], known, terms)
        return joints


Decoding = JointDecoding | ArmDecoding | HandDecoding


def points_of(features: Float[np.ndarray, "N Y"], n_points: int) -> Float[np.ndarray, "N P 3"]:
    """The positions of a person's points in the first frame of each row of features or windows."""
    return features[:, : 3 * n_points].reshape(-1, n_points, 3)


def open_robot(checkpoint: Checkpoint, robot: str | None = None, source: RobotSource = "own") -> RobotModel:
    """The robot of a name or path, with the joints that the model drives. `UserError` where it lacks them.

    Default: the robot that the model was trained for; for a model of a second human, that of its dataset.
    `source`: see `load_robot`.
    """
    interface = checkpoint.robot
    if interface is None:
        return load_robot(robot or robot_of(checkpoint.dataset), source=source)
    return load_robot(robot or interface.name, interface.joint_names, interface.end_effector, source)


def hand_map_of(checkpoint: Checkpoint, robot: RobotModel) -> HandMap | None:
    """How a robot's hands follow a person's, if the model decodes them. `UserError` if it has not one for each."""
    return None if checkpoint.workspace is None else hand_map(robot, checkpoint.workspace)


def decoding_of(checkpoint: Checkpoint, robot: RobotModel, rate: float) -> Decoding:
    """How a robot takes over what a model decodes at `rate` [Hz].

    Raises:
        UserError: if the model drives other joints than the robot's, or two hands and the robot has one.
    """
    if checkpoint.robot is None:
        follow = hand_map_of(checkpoint, robot)
        return ArmDecoding(robot, rate) if follow is None else HandDecoding(robot, follow, rate)
    joints = robot.chain.joint_names
    if checkpoint.robot.joint_names != joints:
        raise UserError(
            f"model '{checkpoint.name}' drives the joints {', '.join(checkpoint.robot.joint_names)}; "
            f"robot '{robot.name}' is controlled by {', '.join(joints)}"
        )
    return JointDecoding(joints)
