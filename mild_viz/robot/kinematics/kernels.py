"""Compiled kernels of kinematics: end effector, Jacobian, poses of all moving links.

They work on plain float64 arrays. An arm is one array (J+1, 12); row i holds the fixed transform before
joint i as a quaternion (wxyz) and a translation, the joint's axis, its lower and its upper limit; in the last
row only the transform to the end effector counts. The typed wrappers are `ik`, `tree` and `chain`.
"""

import math

import numpy as np
from numba import njit

AXIS, LOWER, UPPER = 7, 10, 11
"""Columns of an arm array; the quaternion starts at 0, the translation at 4."""


@njit(cache=True, fastmath=False)
def multiply(aw, ax, ay, az, bw, bx, by, bz):
    """Quaternion product a b."""
    w = aw * bw - ax * bx - ay * by - az * bz
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return w, x, y, z


@njit(cache=True, fastmath=False)
def rotate(w, x, y, z, vx, vy, vz):
    """Vector v turned by the unit quaternion (w, x, y, z)."""
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx


@njit(cache=True, fastmath=False)
def arm_forward(arm, q, origins, directions, position):
    """Forward kinematics: fills joint `origins` and `directions` (J, 3) and the end's `position` (3,).

    Returns the end's rotation as a quaternion (wxyz); where nobody asks for it, it costs nothing.
    """
    w, x, y, z, px, py, pz = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    n = q.shape[0]
    for i in range(n + 1):
        dx, dy, dz = rotate(w, x, y, z, arm[i, 4], arm[i, 5], arm[i, 6])
        px, py, pz = px + dx, py + dy, pz + dz
        if i == n:
            break
        w, x, y, z = multiply(w, x, y, z, arm[i, 0], arm[i, 1], arm[i, 2], arm[i, 3])
        ax, ay, az = arm[i, AXIS], arm[i, AXIS + 1], arm[i, AXIS + 2]
        origins[i, 0], origins[i, 1], origins[i, 2] = px, py, pz
        directions[i, 0], directions[i, 1], directions[i, 2] = rotate(w, x, y, z, ax, ay, az)
        s, c = math.sin(0.5 * q[i]), math.cos(0.5 * q[i])
        w, x, y, z = multiply(w, x, y, z, c, s * ax, s * ay, s * az)
    position[0], position[1], position[2] = px, py, pz
    return multiply(w, x, y, z, arm[n, 0], arm[n, 1], arm[n, 2], arm[n, 3])


@njit(cache=True, fastmath=False)
def arm_jacobian(origins, directions, position, jacobian):
    """Row i of `jacobian` (J, 3) becomes the derivative of the position by joint i."""
    for i in range(origins.shape[0]):
        rx, ry, rz = position[0] - origins[i, 0], position[1] - origins[i, 1], position[2] - origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        jacobian[i, 0], jacobian[i, 1], jacobian[i, 2] = dy * rz - dz * ry, dz * rx - dx * rz, dx * ry - dy * rx


@njit(cache=True, fastmath=False)
def kinematics_batch(arm, joints):
    """End effector positions (N, 3) and their Jacobians (N, J, 3) of N configurations (N, J)."""
    n, size = joints.shape
    origins, directions = np.empty((size, 3)), np.empty((size, 3))
    positions, jacobians = np.empty((n, 3)), np.empty((n, size, 3))
    for k in range(n):
        arm_forward(arm, joints[k], origins, directions, positions[k])
        arm_jacobian(origins, directions, positions[k], jacobians[k])
    return positions, jacobians


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
