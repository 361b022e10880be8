"""Poses of every drawn link: the part of the tree that moves with the controlled joints, and the rest of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from mild_viz.robot.chain import kernel_array, quaternions
from mild_viz.robot.description import TURNING, Description


@dataclass(frozen=True, eq=False)
class LinkTree:
    """L links, K of which move with the J controlled joints through M turning joints.

    Arrays are laid out as `kernels.link_pose_batch` takes them.
    """

    link_names: tuple[str, ...]
    moving: tuple[str, ...]
    """Links whose pose depends on the controlled joints; the others keep their resting pose."""
    resting: Float[np.ndarray, "L 7"]
    node_numbers: Int[np.ndarray, "M 2"]
    nodes: Float[np.ndarray, "M 12"]
    link_numbers: Int[np.ndarray, "K 2"]
    links: Float[np.ndarray, "K 7"]

    def poses(self, joints: Float[np.ndarray, "N J"]) -> Float[np.ndarray, "N L 7"]:
        """Pose (wxyz, xyz [m]) of every link in the base frame at N joint vectors [rad]."""
        from mild_viz.robot.kinematics.kernels import link_pose_batch

        poses = np.empty((len(joints), *self.resting.shape))
        poses[:] = self.resting
        link_pose_batch(self.node_numbers, self.nodes, self.link_numbers, self.links, kernel_array(joints), poses)
        return poses


def build_tree(
    description: Description, joint_names: tuple[str, ...], rest: dict[str, float], link_names: tuple[str, ...]
) -> LinkTree:
    """Fold everything that does not turn; mimic joints of controlled joints turn with them."""
    values = description.values(rest)
    absolute = {description.root: np.eye(4)}  # resting pose in the base
    anchor = {description.root: (-1, np.eye(4))}  # node that the link hangs on, and its fixed pose there
    node_numbers: list[tuple[int, int]] = []
    nodes: list[Float[np.ndarray, "12"]] = []
    for joint in description.joints:
        resting = joint.motion(values[joint.name])
        absolute[joint.child] = absolute[joint.parent] @ resting
        node, fixed = anchor[joint.parent]
        source, gain, bias = (joint.name, 1.0, 0.0) if joint.mimic is None else joint.mimic
        if joint.kind in TURNING and source in joint_names:
            turn = np.array([gain, bias])
            nodes.append(np.concatenate([_pose(fixed @ joint.origin), joint.axis, turn]))
            node_numbers.append((node, joint_names.index(source)))
            anchor[joint.child] = (len(nodes) - 1, np.eye(4))
        else:
            anchor[joint.child] = (node, fixed @ resting)
    moving = tuple(name for name in link_names if anchor[name][0] >= 0)
    return LinkTree(
        link_names,
        moving,
        np.array([_pose(absolute[name]) for name in link_names]).reshape(-1, 7),
        np.array(node_numbers, dtype=np.int64).reshape(-1, 2),
        np.array(nodes).reshape(-1, 12),
        np.array([(anchor[name][0], link_names.index(name)) for name in moving], dtype=np.int64).reshape(-1, 2),
        np.array([_pose(anchor[name][1]) for name in moving]).reshape(-1, 7),
    )


def _pose(transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "7"]:
    """wxyz and xyz of a transform."""
    return np.concatenate([quaternions(transform[None, :3, :3])[0], transform[:3, 3]])
