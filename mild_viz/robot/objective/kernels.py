"""Compiled objective of inverse kinematics: value, half the gradient, half the exact Hessian.

They work on plain float64 arrays; an arm is laid out as `kinematics.kernels` says, the optional terms as below. The
typed wrapper is `terms`. `robot/kernels.py` calls them: after a change here, remove its __pycache__.
"""

import numpy as np
from numba import njit

from mild_viz.robot.kinematics.kernels import arm_jacobian, rotate

TURN, TOOL_AXES, TOOL_DIRECTIONS, ELBOW, ELBOW_JOINT, ELBOW_POINT, JOINT_WEIGHTS = 0, 1, 10, 19, 20, 21, 24
"""Slots of the optional terms (24 + J,), which `terms.packed` fills: weight of the orientation, up to three tool axes
and where they should point; weight of the elbow, the joint that lies there, its wanted place; weights of the prior."""


@njit(cache=True, fastmath=False)
def plain_terms(n):
    """Optional terms (24 + J,) of which none counts: Eq. ik-prior-simplified alone."""
    terms = np.zeros(JOINT_WEIGHTS + n)
    for i in range(n):
        terms[JOINT_WEIGHTS + i] = 1.0
    return terms


@njit(cache=True, fastmath=False)
def objective(position, rotation, origins, target, q, prior, lambda_x, lambda_q, terms):
    """Eq. ik-prior-simplified, and the terms of `terms.IKTerms` that count."""
    reach = (position[0] - target[0]) ** 2 + (position[1] - target[1]) ** 2 + (position[2] - target[2]) ** 2
    stray = 0.0
    for i in range(q.shape[0]):
        stray += terms[JOINT_WEIGHTS + i] * (q[i] - prior[i]) ** 2
    total = lambda_x * reach + lambda_q * stray
    if terms[TURN] > 0.0:
        tilt, (w, x, y, z) = 0.0, rotation
        for k in range(3):
            axis, wanted = TOOL_AXES + 3 * k, TOOL_DIRECTIONS + 3 * k
            rx, ry, rz = rotate(w, x, y, z, terms[axis], terms[axis + 1], terms[axis + 2])
            tilt += (rx - terms[wanted]) ** 2 + (ry - terms[wanted + 1]) ** 2 + (rz - terms[wanted + 2]) ** 2
        total += terms[TURN] * tilt
    if terms[ELBOW] > 0.0:
        elbow = origins[int(terms[ELBOW_JOINT])]
        ex, ey, ez = elbow[0] - terms[ELBOW_POINT], elbow[1] - terms[ELBOW_POINT + 1], elbow[2] - terms[ELBOW_POINT + 2]
        total += terms[ELBOW] * (ex * ex + ey * ey + ez * ez)
    return total


@njit(cache=True, fastmath=False)
def _add_point(jacobian, directions, n, ex, ey, ez, weight, gradient, hessian):
    """Add half the derivatives of weight |e|^2, where e is the error of a point that the first n joints move.

    For turning joints i <= j the second derivative of the point is directions[i] x jacobian[j].
    """
    for i in range(n):
        ax, ay, az = directions[i, 0], directions[i, 1], directions[i, 2]
        gx, gy, gz = jacobian[i, 0], jacobian[i, 1], jacobian[i, 2]
        gradient[i] += weight * (gx * ex + gy * ey + gz * ez)
        # e . (a x J_j) = J_j . (e x a)
        gx, gy, gz = gx + ey * az - ez * ay, gy + ez * ax - ex * az, gz + ex * ay - ey * ax
        for j in range(i, n):
            hessian[i, j] += weight * (jacobian[j, 0] * gx + jacobian[j, 1] * gy + jacobian[j, 2] * gz)


@njit(cache=True, fastmath=False)
def _add_turn(directions, rotation, terms, gradient, hessian):
    """Add half the derivatives of the orientation term.

    With r the turned tool axis, d where it should point, and joints i <= j about z: the derivative of r is z_i x r,
    the second one z_i x (z_j x r).
    """
    n, weight, (w, x, y, z) = directions.shape[0], terms[TURN], rotation
    for k in range(3):
        axis, wanted = TOOL_AXES + 3 * k, TOOL_DIRECTIONS + 3 * k
        rx, ry, rz = rotate(w, x, y, z, terms[axis], terms[axis + 1], terms[axis + 2])
        dx, dy, dz = terms[wanted], terms[wanted + 1], terms[wanted + 2]
        along = weight * (rx * dx + ry * dy + rz * dz)
        wx, wy, wz = weight * (ry * dz - rz * dy), weight * (rz * dx - rx * dz), weight * (rx * dy - ry * dx)
        for i in range(n):
            zx, zy, zz = directions[i, 0], directions[i, 1], directions[i, 2]
            gradient[i] -= zx * wx + zy * wy + zz * wz
            # -d . (z_i x (z_j x r)) = z_j . ((d . r) z_i - (z_i . r) d)
            turned = weight * (zx * rx + zy * ry + zz * rz)
            gx, gy, gz = along * zx - turned * dx, along * zy - turned * dy, along * zz - turned * dz
            for j in range(i, n):
                hessian[i, j] += directions[j, 0] * gx + directions[j, 1] * gy + directions[j, 2] * gz


@njit(cache=True, fastmath=False)
def derivatives(
    frames, position, rotation, target, q, prior, lambda_x, lambda_q, terms, gradient, hessian
):  # fmt: skip
    """Half the gradient (J,) and half the exact Hessian (J, J) of `objective`."""
    n = q.shape[0]
    origins, directions, jacobian = frames[0], frames[1], frames[2]
    for i in range(n):
        gradient[i] = lambda_q * terms[JOINT_WEIGHTS + i] * (q[i] - prior[i])
        for j in range(i, n):
            hessian[i, j] = lambda_q * terms[JOINT_WEIGHTS + i] if i == j else 0.0
    arm_jacobian(origins, directions, position, jacobian)
    ex, ey, ez = position[0] - target[0], position[1] - target[1], position[2] - target[2]
    _add_point(jacobian, directions, n, ex, ey, ez, lambda_x, gradient, hessian)
    if terms[ELBOW] > 0.0:
        joint = int(terms[ELBOW_JOINT])
        elbow = origins[joint]
        arm_jacobian(origins, directions, elbow, jacobian)
        ex, ey = elbow[0] - terms[ELBOW_POINT], elbow[1] - terms[ELBOW_POINT + 1]
        ez = elbow[2] - terms[ELBOW_POINT + 2]
        _add_point(jacobian, directions, joint, ex, ey, ez, terms[ELBOW], gradient, hessian)
    if terms[TURN] > 0.0:
        _add_turn(directions, rotation, terms, gradient, hessian)
    for i in range(n):
        for j in range(i):
            hessian[i, j] = hessian[j, i]
