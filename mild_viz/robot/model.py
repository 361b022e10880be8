"""A robot as the pipeline and the page know it: the controlled arm, and where every drawn link is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain, load_chain
from mild_viz.robot.description import Description, read_description
from mild_viz.robot.ik import forward
from mild_viz.robot.kinematics.tree import LinkTree, build_tree
from mild_viz.robot.robots import ROBOTS, find_urdf
from mild_viz.robot.visuals import drawn_links, load_visuals

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot whose J joints of one arm are controlled; all other joints rest."""

    name: str
    chain: ArmChain
    tree: LinkTree
    rest: dict[str, float]
    """Where the joints rest [rad]; those not named at 0."""
    hands: dict[str, dict[str, float]]
    """Where the joints of the hand stand instead during each action [rad]."""
    description: Description

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
            values = self.description.values(self.rest)
            pose = np.eye(4)
            for joint in self.description.path_to(footprint[0]):
                pose = pose @ joint.motion(values[joint.name])
            return float(pose[2, 3])
        poses = dict(zip(self.link_names, self.tree.resting, strict=True))
        return min((_lowest(mesh, poses[name]) for name, mesh in self.visuals.items()), default=0.0)

    def link_poses(self, joints: Float[np.ndarray, "N J"], action: str | None = None) -> Float[np.ndarray, "N L 7"]:
        """Pose of every drawn link in the base frame (wxyz, xyz [m]) at N joint vectors [rad].

        With an action, the hand has the posture of that action; the end effector is where it is without.
        """
        self._check(joints)
        tree = self.tree if action is None else self._trees.get(action, self.tree)
        return tree.poses(joints)

    @cached_property
    def _trees(self) -> dict[str, LinkTree]:
        return {
            action: build_tree(self.description, self.chain.joint_names, self.rest | hand, self.link_names)
            for action, hand in self.hands.items()
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
    name_or_path: str, joint_names: tuple[str, ...] | None = None, end_effector: str | None = None
) -> RobotModel:
    """A robot by its name in `ROBOTS` or by the path of its URDF.

    Joints and end effector default to those of the known robot, else to Pepper's right arm. Raises
    `UserError` where the description is missing or broken, or lacks them (listing what it has).
    """
    name, path = find_urdf(name_or_path)
    known = ROBOTS.get(name_or_path, ROBOTS["pepper"])
    joint_names = known.joint_names if joint_names is None else tuple(joint_names)
    description = read_description(path)
    chain = load_chain(description, joint_names, end_effector or known.end_effector, known.rest)
    tree = build_tree(description, joint_names, known.rest, drawn_links(description))
    return RobotModel(name, chain, tree, known.rest, known.hands, description)
