"""Compiled kernels of the arm: kinematics, inverse kinematics with a joint prior, the control loop.

They stay in one file because numba's cache notices changes only in a function's own file. Everything works
on plain float64 arrays. An arm is one array (J+1, 12); row i holds the fixed transform before joint i as a
quaternion (wxyz) and a translation, the joint's axis, its lower and its upper limit; in the last row only
the transform to the end effector counts. The typed wrappers live in `chain`, `ik` and `controller`.
"""

import math

import numpy as np
from numba import njit

AXIS, LOWER, UPPER, WIDTH = 7, 10, 11, 12
"""Columns of an arm array (the quaternion starts at 0, the translation at 4), and its width."""

BASE_IK, MILD, MILD_IK = 0, 1, 2
"""Controllers, in the order of `settings.CONTROLLERS`."""

STARTED, IN_CONTACT, VISITED = 0, 1, 2
"""Slots of the carry's flags: a command was sent; contact was reached; bit mask of states seen before it."""

MAX_ITERATIONS = 200
TOLERANCE = 1e-10
"""Largest projected gradient at which the solver stops, relative to the larger weight (at least 1)."""


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
    """Forward kinematics: fills joint `origins` and `directions` (J, 3) and the end's `position` (3,)."""
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
def _objective(position, target, q, prior, lambda_x, lambda_q):
    """Eq. ik-prior-simplified."""
    reach = (position[0] - target[0]) ** 2 + (position[1] - target[1]) ** 2 + (position[2] - target[2]) ** 2
    stray = 0.0
    for i in range(q.shape[0]):
        stray += (q[i] - prior[i]) ** 2
    return lambda_x * reach + lambda_q * stray


@njit(cache=True, fastmath=False)
def _derivatives(jacobian, directions, position, target, q, prior, lambda_x, lambda_q, gradient, hessian):
    """Half the gradient (J,) and half the exact Hessian (J, J) of Eq. ik-prior-simplified.

    For turning joints i <= j the second derivative of the position is directions[i] x jacobian[j].
    """
    n = q.shape[0]
    ex, ey, ez = position[0] - target[0], position[1] - target[1], position[2] - target[2]
    for i in range(n):
        ax, ay, az = directions[i, 0], directions[i, 1], directions[i, 2]
        gx, gy, gz = jacobian[i, 0], jacobian[i, 1], jacobian[i, 2]
        gradient[i] = lambda_x * (gx * ex + gy * ey + gz * ez) + lambda_q * (q[i] - prior[i])
        # e . (a x J_j) = J_j . (e x a)
        gx, gy, gz = gx + ey * az - ez * ay, gy + ez * ax - ex * az, gz + ex * ay - ey * ax
        for j in range(i, n):
            hessian[i, j] = lambda_x * (jacobian[j, 0] * gx + jacobian[j, 1] * gy + jacobian[j, 2] * gz)
            if i == j:
                hessian[i, j] += lambda_q
            hessian[j, i] = hessian[i, j]


@njit(cache=True, fastmath=False)
def _held(arm, q, gradient, i):
    """Whether the gradient pushes joint i against the limit that it stands on."""
    return (q[i] <= arm[i, LOWER] and gradient[i] > 0.0) or (q[i] >= arm[i, UPPER] and gradient[i] < 0.0)


@njit(cache=True, fastmath=False)
def _free_step(hessian, damping, gradient, step, fixed, factor, rhs):
    """Solve (H + damping I) step = -gradient for the joints that are not fixed; False where not convex."""
    n = step.shape[0]
    for i in range(n):
        if fixed[i]:
            continue
        rhs[i] = -gradient[i]
        for j in range(n):
            if fixed[j]:
                rhs[i] -= hessian[i, j] * step[j]
        # row i of the Cholesky factor, and the forward substitution
        for j in range(i + 1):
            if fixed[j]:
                continue
            total = hessian[i, j] + (damping if i == j else 0.0)
            for k in range(j):
                if not fixed[k]:
                    total -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = total / factor[j, j]
                rhs[i] -= factor[i, j] * rhs[j]
            elif total > 1e-12 * (abs(hessian[i, i]) + damping):
                factor[i, i] = math.sqrt(total)
            else:
                return False
        rhs[i] /= factor[i, i]
    for i in range(n - 1, -1, -1):
        if not fixed[i]:
            total = rhs[i]
            for k in range(i + 1, n):
                if not fixed[k]:
                    total -= factor[k, i] * step[k]
            step[i] = total / factor[i, i]
    return True


@njit(cache=True, fastmath=False)
def _bounded_step(arm, hessian, damping, gradient, q, step, fixed, factor, rhs):
    """Minimise the damped quadratic model inside the limits; False where it is not convex.

    Active set: joints that the gradient pushes against their limit stay; a joint that the step would
    carry over its limit is put on it, and the others are solved again.
    """
    n = q.shape[0]
    for i in range(n):
        step[i], fixed[i] = 0.0, _held(arm, q, gradient, i)
    inside = False
    while not inside and _free_step(hessian, damping, gradient, step, fixed, factor, rhs):
        inside = True
        for i in range(n):
            if not fixed[i] and not arm[i, LOWER] <= q[i] + step[i] <= arm[i, UPPER]:
                bound = arm[i, LOWER] if q[i] + step[i] < arm[i, LOWER] else arm[i, UPPER]
                step[i], fixed[i], inside = bound - q[i], True, False
    return inside


@njit(cache=True, fastmath=False)
def ik_scratch(n):
    """Scratch arrays of `solve_ik_one` for n joints."""
    size = max(n, 3)
    return np.zeros((6, size)), np.zeros((5, size, size)), np.zeros(n, np.bool_)


@njit(cache=True, fastmath=False)
def solve_ik_one(arm, target, prior, lambda_x, lambda_q, q, vectors, matrices, fixed):
    """Bounded Levenberg-Marquardt from the prior (J,), with the exact Hessian; the solution is left in `q`.

    Minimises Eq. ik-prior-simplified for a target (3,). No accepted step increases the objective, and no
    iterate leaves the limits. `vectors`, `matrices`, `fixed` are scratch from `ik_scratch`.
    """
    n = q.shape[0]
    gradient, step, candidate, rhs = vectors[0, :n], vectors[1, :n], vectors[2, :n], vectors[3, :n]
    position, moved = vectors[4, :3], vectors[5, :3]
    hessian, factor = matrices[0, :n, :n], matrices[1, :n, :n]
    origins, directions, jacobian = matrices[2, :n, :3], matrices[3, :n, :3], matrices[4, :n, :3]
    for i in range(n):
        q[i] = min(max(prior[i], arm[i, LOWER]), arm[i, UPPER])
    arm_forward(arm, q, origins, directions, position)
    cost = _objective(position, target, q, prior, lambda_x, lambda_q)
    scale = max(lambda_x, lambda_q)
    new_cost, damping, growth = cost, 0.0, 2.0
    for _ in range(MAX_ITERATIONS):
        arm_jacobian(origins, directions, position, jacobian)
        _derivatives(jacobian, directions, position, target, q, prior, lambda_x, lambda_q, gradient, hessian)
        largest = 0.0
        for i in range(n):
            if not _held(arm, q, gradient, i):
                largest = max(largest, 2.0 * abs(gradient[i]))
        if largest <= TOLERANCE * max(1.0, scale):
            # One more Newton step squares what is left, so that a prior that differs by rounding (one
            # observation at a time instead of all) gives the same solution to rounding. Where the arm can turn
            # freely about its solution (no prior), the step is no such refinement and would be large.
            if _bounded_step(arm, hessian, 0.0, gradient, q, step, fixed, factor, rhs):
                for i in range(n):
                    if not fixed[i] and abs(step[i]) < 1e-6:
                        q[i] = min(max(q[i] + step[i], arm[i, LOWER]), arm[i, UPPER])
            break
        improved = False
        while not improved and damping < 1e6 * scale:
            if _bounded_step(arm, hessian, damping, gradient, q, step, fixed, factor, rhs):
                predicted = 0.0
                for i in range(n):
                    candidate[i] = min(max(q[i] + step[i], arm[i, LOWER]), arm[i, UPPER])
                    if fixed[i] and step[i] != 0.0:  # exactly on the limit, where rounding would miss it
                        candidate[i] = arm[i, UPPER if step[i] > 0.0 else LOWER]
                    predicted -= 2.0 * step[i] * gradient[i]
                    for j in range(n):
                        predicted -= step[i] * hessian[i, j] * step[j]
                arm_forward(arm, candidate, origins, directions, moved)
                new_cost = _objective(moved, target, candidate, prior, lambda_x, lambda_q)
                improved = new_cost <= cost
            if improved:
                gain = (cost - new_cost) / predicted if predicted > 0.0 else 0.0
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
                damping, growth = (damping if damping > 1e-12 * scale else 0.0), 2.0
            else:
                damping, growth = max(damping * growth, 1e-3 * scale), 2.0 * growth
        if not improved or (candidate == q).all():
            break
        q[:], position[:], cost = candidate, moved, new_cost


@njit(cache=True, fastmath=False)
def solve_ik_batch(arm, targets, priors, lambda_x, lambda_q):
    """Solve N problems, each from its own prior (N, J); a NaN target (N, 3) gives the clipped prior."""
    n, size = priors.shape
    vectors, matrices, fixed = ik_scratch(size)
    solutions = np.empty((n, size))
    for k in range(n):
        solutions[k] = np.clip(priors[k], arm[:-1, LOWER], arm[:-1, UPPER])
        if np.isfinite(targets[k]).all():
            solve_ik_one(arm, targets[k], priors[k], lambda_x, lambda_q, solutions[k], vectors, matrices, fixed)
    return solutions


@njit(cache=True, fastmath=False)
def _argmax(values, excluded):
    """Index of the largest value whose bit is not set in `excluded`; the first one where they are equal."""
    best = -1
    for i in range(values.shape[0]):
        if (excluded >> i) & 1 == 0 and (best < 0 or values[i] > values[best]):
            best = i
    return best


@njit(cache=True, fastmath=False)
def control_loop(
    arm, controller, lambda_x, lambda_q, contact_states, smoothing, contact_stiffness, log_alpha, decoded, targets,
    previous, flags,
):  # fmt: skip
    """Algorithm vae-HMM-test from the decoded joints on, over N frames; `previous` and `flags` carry over.

    contact_states is a bit mask. Returns commands (N, J), the contact flag (N,) that gates the IK, and the
    stiffness (N,). `previous` (J,) is the last command; `flags` (3,): see STARTED, IN_CONTACT, VISITED.
    """
    n, size = decoded.shape
    vectors, matrices, fixed = ik_scratch(size)
    commands, contact, stiffness = np.empty((n, size)), np.zeros(n, np.bool_), np.ones(n)
    for k in range(n):
        active = _argmax(log_alpha[k], 0)
        contact[k] = (contact_states >> active) & 1 == 1
        command, target = commands[k], targets[k]
        prior, weight = (previous, 0.0) if controller == BASE_IK else (decoded[k], lambda_q)
        if controller != MILD and (contact[k] or controller == BASE_IK) and np.isfinite(target).all():
            solve_ik_one(arm, target, prior, lambda_x, weight, command, vectors, matrices, fixed)
        else:
            command[:] = prior
        for i in range(size):
            limited = min(max(command[i], arm[i, LOWER]), arm[i, UPPER])
            if flags[STARTED] == 1:
                limited = smoothing * limited + (1.0 - smoothing) * previous[i]
            command[i] = min(max(limited, arm[i, LOWER]), arm[i, UPPER])
        previous[:] = command
        flags[STARTED] = 1

        # the segment that drives the stiffness never returns to a state seen before the first contact
        if contact[k]:
            flags[IN_CONTACT] = 1
        elif flags[IN_CONTACT] == 0:
            flags[VISITED] |= 1 << active
        if flags[IN_CONTACT] == 1 and (contact_states >> _argmax(log_alpha[k], flags[VISITED])) & 1 == 1:
            stiffness[k] = contact_stiffness
    return commands, contact, stiffness
