"""Compiled kernel of the link poses; its typed wrapper is `tree`."""

import math

import numpy as np
from numba import njit

from mild_viz.robot.kernels import multiply, rotate


@njit(cache=True, fastmath=False)
def link_pose_batch(node_numbers, nodes, link_numbers, links, joints, poses):
    """Write the poses (wxyz, xyz) of every moving link at joints (N, J) into `poses` (N, L, 7).

    Nodes are the joints that turn, parents first. node_numbers (M, 2): parent node (-1: the base) and the
    column of `joints` that turns it. nodes (M, 12): fixed quaternion and translation from the parent, axis,
    gain and bias of the angle. link_numbers (K, 2): node that the link hangs on, and its column in `poses`.
    links (K, 7): fixed quaternion and translation from the node.
    """
    node_poses = np.empty((nodes.shape[0], 7))
    for k in range(joints.shape[0]):
        for m in range(nodes.shape[0]):
            w, x, y, z, px, py, pz = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            fixed, pose = nodes[m], node_poses[m]
            if node_numbers[m, 0] >= 0:
                w, x, y, z, px, py, pz = node_poses[node_numbers[m, 0]]
            dx, dy, dz = rotate(w, x, y, z, fixed[4], fixed[5], fixed[6])
            pose[4], pose[5], pose[6] = px + dx, py + dy, pz + dz
            w, x, y, z = multiply(w, x, y, z, fixed[0], fixed[1], fixed[2], fixed[3])
            half = 0.5 * (fixed[10] * joints[k, node_numbers[m, 1]] + fixed[11])
            s, c = math.sin(half), math.cos(half)
            pose[0], pose[1], pose[2], pose[3] = multiply(w, x, y, z, c, s * fixed[7], s * fixed[8], s * fixed[9])
        for m in range(links.shape[0]):
            w, x, y, z, px, py, pz = node_poses[link_numbers[m, 0]]
            fixed, pose = links[m], poses[k, link_numbers[m, 1]]
            pose[0], pose[1], pose[2], pose[3] = multiply(w, x, y, z, fixed[0], fixed[1], fixed[2], fixed[3])
            dx, dy, dz = rotate(w, x, y, z, fixed[4], fixed[5], fixed[6])
            pose[4], pose[5], pose[6] = px + dx, py + dy, pz + dz
