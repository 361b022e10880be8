"""A robot as the pipeline and the page know it: the controlled arm, and where every drawn link is."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain, load_chain
from mild_viz.robot.description import TURNING, Description, read_description
from mild_viz.robot.ik import forward
from mild_viz.robot.kinematics.tree import LinkTree, build_tree
from mild_viz.robot.robots import find_robot
from mild_viz.robot.source import RobotSource, published_description
from mild_viz.robot.spec import ArmSpec, RobotSpec
from mild_viz.robot.visuals import drawn_links, load_visuals

if TYPE_CHECKING:
    import trimesh

logger = logging.getLogger(__name__)

MOVING = (*TURNING, "prismatic")
"""Joint types that a robot.toml may give a value to."""


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot of which the joints of one arm or more are controlled; all other joints rest."""

    name: str
    spec: RobotSpec
    arms: Mapping[str, ArmChain]
    """The arms that can be controlled, by name; the first one interacts, and drives what `chain` says."""
    tree: LinkTree
    """Moves with the joints of all arms, one arm after the other."""
    description: Description

    @cached_property
    def chain(self) -> ArmChain:
        """The arm that interacts, of J joints."""
        return next(iter(self.arms.values()))

    @property
    def title(self) -> str:
        """The robot's name as its maker writes it."""
        return self.spec.title

    @property
    def urdf(self) -> Path:
        return self.description.path

    @property
    def link_names(self) -> tuple[str, ...]:
        """The drawn links, in the order of `link_poses`."""
        return self.tree.link_names

    @property
    def moving_links(self) -> tuple[str, ...]:
        """Drawn links that move with the controlled joints; the others always keep their resting pose."""
        return self.tree.moving

    @cached_property
    def visuals(self) -> dict[str, trimesh.Trimesh]:
        """One coloured mesh per drawn link, in the link's frame [m]; read at the first use."""
        return load_visuals(self.description)

    @cached_property
    def floor(self) -> float:
        """Height of the floor that the resting robot stands on, in the base frame [m]."""
        footprint = [joint.child for joint in self.description.joints if joint.child == "base_footprint"]
        if footprint:
            return float(self.description.pose(footprint[0], dict(self.spec.rest))[2, 3])
        poses = dict(zip(self.link_names, self.tree.resting, strict=True))
        return min((_lowest(mesh, poses[name]) for name, mesh in self.visuals.items()), default=0.0)

    def link_poses(
        self,
        joints: Float[np.ndarray, "N J"],
        action: str | None = None,
        others: Mapping[str, Float[np.ndarray, "N _"]] | None = None,
    ) -> Float[np.ndarray, "N L 7"]:
        """Pose of every drawn link in the base frame (wxyz, xyz [m]) at N joint vectors [rad] of the first arm.

        The other arms rest, unless `others` has their joints. With an action, the hand has the posture of that
        action; the end effector is where it is without.
        """
        self._check(joints)
        tree = self.tree if action is None else self._trees.get(action, self.tree)
        if len(self.arms) == 1:
            return tree.poses(joints)
        names = list(self.arms)[1:]
        unknown = sorted(set(others or ()) - set(names))
        if unknown:
            raise UserError(f"robot {self.name} has no other arm '{unknown[0]}'; valid: {', '.join(names)}")
        rows = [(others or {}).get(name, np.tile(self.arms[name].rest, (len(joints), 1))) for name in names]
        return tree.poses(np.concatenate([joints, *rows], axis=1))

    @cached_property
    def _trees(self) -> dict[str, LinkTree]:
        return {
            action: build_tree(self.description, _all_joints(self.arms), {**self.spec.rest, **hand}, self.link_names)
            for action, hand in self.spec.hands.items()
        }

    def end_effector(self, joints: Float[np.ndarray, "N J"]) -> Float[np.ndarray, "N 3"]:
        """Position of the end effector in the base frame [m] at N joint vectors [rad]."""
        self._check(joints)
        return forward(self.chain, joints)

    def _check(self, joints: Float[np.ndarray, "N J"]) -> None:
        if joints.ndim != 2 or joints.shape[1] != self.chain.n_joints:
            expected = ", ".join(self.chain.joint_names)
            raise UserError(f"joints have the shape {joints.shape}; expected a row of {expected} per frame")


def _lowest(mesh: trimesh.Trimesh, pose: Float[np.ndarray, "7"]) -> float:
    """Smallest z of a mesh in a pose (wxyz, xyz)."""
    w, x, y, z = pose[:4]
    up = np.array([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)])
    return float(pose[6] + np.min(mesh.vertices @ up))


def load_robot(
    name_or_path: str,
    joint_names: tuple[str, ...] | None = None,
    end_effector: str | None = None,
    source: RobotSource = "own",
) -> RobotModel:
    """A robot by its name in `ROBOTS`, its folder (with a robot.toml), or the path of its URDF.

    Joints and end effector of the interacting arm default to those of the robot's first arm, else to Pepper's right
    one. With the source `robot_descriptions`, its looks are those of the manufacturer's description; where that cannot
    be had, a warning says why, and they are ours.

    Raises `UserError` where the description is missing or broken, or lacks joints (listing what it has).
    """
    spec = find_robot(name_or_path)
    description = read_description(spec.urdf)
    _check_values(spec, description)
    arms = {arm.name: arm for arm in _interacting_first(spec, joint_names, end_effector)}
    chains = {
        name: replace(
            load_chain(description, arm.joints, arm.end_effector, dict(spec.rest), arm.tip_offset),
            elbow=arm.elbow,
            position=arm.position,
        )
        for name, arm in arms.items()
    }
    tree = build_tree(description, _all_joints(chains), dict(spec.rest), drawn_links(description))
    robot = RobotModel(spec.name, replace(spec, arms=arms), chains, tree, description)
    return robot if source == "own" else _with_looks_of(robot, source)


def _with_looks_of(robot: RobotModel, source: RobotSource) -> RobotModel:
    """The robot, drawn as its manufacturer's description has it; as it is, with a warning, where that cannot be had."""
    try:
        theirs = published_description(robot.spec, robot.description)
        tree = build_tree(theirs, _all_joints(robot.arms), dict(robot.spec.rest), drawn_links(theirs))
        drawn = replace(robot, tree=tree, description=theirs)
        _ = drawn.visuals  # read now: a mesh that is missing is found out while there is another choice
    except UserError as error:
        logger.warning("%s: no robot from %s, ours is shown: %s", robot.title, source, error)
        return robot
    return drawn


def _interacting_first(spec: RobotSpec, joint_names: tuple[str, ...] | None, end_effector: str | None) -> list[ArmSpec]:
    """The robot's arms, first the one of these joints; an arm that the robot does not know takes the first's place."""
    arms = list(spec.arms.values())
    joint_names = arms[0].joints if joint_names is None else tuple(joint_names)
    known = next((arm for arm in arms if arm.joints == joint_names), None)
    first = known or ArmSpec(arms[0].name, joint_names, arms[0].end_effector, arms[0].tip_offset)
    if end_effector is not None and end_effector != first.end_effector:
        first = replace(first, end_effector=end_effector, tip_offset=(0.0, 0.0, 0.0))
    # an arm that shares a joint with it would be controlled twice
    return [first] + [arm for arm in arms if arm.name != first.name and not set(arm.joints) & set(first.joints)]


def _check_values(spec: RobotSpec, description: Description) -> None:
    """`UserError` where a robot.toml gives a value to a joint that its description does not have."""
    have = [joint.name for joint in description.joints if joint.kind in MOVING and joint.mimic is None]
    for where, values in (("rest", spec.rest), *((f"hands.{action}", hand) for action, hand in spec.hands.items())):
        unknown = [name for name in values if name not in have]
        if spec.file is not None and unknown:
            raise UserError(f"{spec.file}: {where}: there is no joint '{unknown[0]}'; valid: {', '.join(have)}")


def _all_joints(arms: Mapping[str, ArmChain]) -> tuple[str, ...]:
    return tuple(name for chain in arms.values() for name in chain.joint_names)
