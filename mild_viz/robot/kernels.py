"""Compiled kernels of inverse kinematics with a joint prior.

They work on plain float64 arrays; an arm is laid out as `kinematics.kernels` says. The typed wrappers are in `ik`.
Kernels that call each other are kept together where possible, because numba's cache notices changes only in a
function's own file: after a change in kinematics/kernels.py or objective/kernels.py, remove __pycache__ here; after one
here, that of control/.
"""

import math

import numpy as np
from numba import njit

from mild_viz.robot.kinematics.kernels import LOWER, UPPER, arm_forward
from mild_viz.robot.objective.kernels import ELBOW, JOINT_WEIGHTS, TURN, derivatives, objective, plain_terms

MAX_ITERATIONS = 200
TOLERANCE = 1e-10
"""Largest projected gradient at which the solver stops, relative to the larger weight (at least 1)."""


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
def copy_into(source, into):
    """Slice assignment, which numba takes seconds to compile."""
    for i in range(into.shape[0]):
        into[i] = source[i]


@njit(cache=True, fastmath=False)
def ik_scratch(n):
    """Scratch arrays of `solve_ik_one` for n joints."""
    return np.empty((4, n)), np.empty((2, 3)), np.empty((3, n, 3)), np.empty((2, n, n)), np.empty(n, np.bool_)


@njit(cache=True, fastmath=False)
def solve_ik_one(arm, target, prior, lambda_x, lambda_q, terms, enough, q, scratch):
    """Bounded Levenberg-Marquardt from the prior (J,), with the exact Hessian; the solution is left in `q`.

    Minimises Eq. ik-prior-simplified for a target (3,), and the optional terms beside it (`plain_terms(J)`: none).
    No accepted step increases the objective, and no iterate leaves the limits; a NaN target leaves the clipped
    prior. A solution that costs no more than `enough` will do; below 0, the best is sought. `scratch` is
    `ik_scratch(J)`. For velocity limits, give the arm that `limit_step` narrows.
    """
    n = q.shape[0]
    vectors, points, frames, squares, fixed = scratch
    gradient, step, candidate, rhs = vectors[0], vectors[1], vectors[2], vectors[3]
    position, moved, hessian, factor = points[0], points[1], squares[0], squares[1]
    origins, directions = frames[0], frames[1]
    scale = max(lambda_x, terms[TURN], terms[ELBOW])
    for i in range(n):
        scale = max(scale, lambda_q * terms[JOINT_WEIGHTS + i])
        q[i] = min(max(prior[i], arm[i, LOWER]), arm[i, UPPER])
    rotation = arm_forward(arm, q, origins, directions, position)
    cost = objective(position, rotation, origins, target, q, prior, lambda_x, lambda_q, terms)
    new_cost, damping, growth, still = cost, 0.0, 2.0, False
    if not math.isfinite(cost):  # there is no target
        return
    for _ in range(MAX_ITERATIONS):
        if cost <= enough:
            return
        derivatives(frames, position, rotation, target, q, prior, lambda_x, lambda_q, terms, gradient, hessian)
        largest = 0.0
        for i in range(n):
            if not _held(arm, q, gradient, i):
                largest = max(largest, 2.0 * abs(gradient[i]))
        if largest <= TOLERANCE * max(1.0, scale):
            break
        improved = False
        while not improved and damping < 1e6 * scale:
            if _bounded_step(arm, hessian, damping, gradient, q, step, fixed, factor, rhs):
                predicted, still = 0.0, True
                for i in range(n):
                    candidate[i] = min(max(q[i] + step[i], arm[i, LOWER]), arm[i, UPPER])
                    if fixed[i] and step[i] != 0.0:  # exactly on the limit, where rounding would miss it
                        candidate[i] = arm[i, UPPER if step[i] > 0.0 else LOWER]
                    still = still and candidate[i] == q[i]
                    predicted -= 2.0 * step[i] * gradient[i]
                    for j in range(n):
                        predicted -= step[i] * hessian[i, j] * step[j]
                rotation = arm_forward(arm, candidate, origins, directions, moved)
                new_cost = objective(moved, rotation, origins, target, candidate, prior, lambda_x, lambda_q, terms)
                improved = new_cost <= cost
            if improved:
                gain = (cost - new_cost) / predicted if predicted > 0.0 else 0.0
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3)
                damping, growth = (damping if damping > 1e-12 * scale else 0.0), 2.0
            else:
                damping, growth = max(damping * growth, 1e-3 * scale), 2.0 * growth
        if not improved or still:
            break
        copy_into(candidate, q)
        copy_into(moved, position)
        cost = new_cost
    # The objective is flat to rounding here, the gradient is not: one more Newton step squares what is left, so that
    # inputs that differ by rounding give the same solution to rounding. Where the arm can turn freely about its
    # solution, the step would be large, and is not taken.
    if _bounded_step(arm, hessian, 0.0, gradient, q, step, fixed, factor, rhs):
        largest = 0.0
        for i in range(n):
            if not fixed[i]:
                largest = max(largest, abs(step[i]))
        for i in range(n):
            if not fixed[i] and largest < 1e-6:
                q[i] = min(max(q[i] + step[i], arm[i, LOWER]), arm[i, UPPER])


@njit(cache=True, fastmath=False)
def limit_step(arm, previous, max_step, narrowed):
    """Fill the limits of `narrowed`, a copy of the arm, with those within `max_step` (J,) of `previous` (J,).

    Where the previous joint is NaN, the limits are the arm's; where it stands outside them, they come first.
    """
    for i in range(previous.shape[0]):
        low, high = arm[i, LOWER], arm[i, UPPER]
        narrowed[i, LOWER], narrowed[i, UPPER] = low, high
        if not math.isnan(previous[i]):
            narrowed[i, LOWER] = min(max(previous[i] - max_step[i], low), high)
            narrowed[i, UPPER] = max(min(previous[i] + max_step[i], high), low)


@njit(cache=True, fastmath=False)
def solve_ik_batch(arm, targets, priors, lambda_x, lambda_q, terms, max_step, previous):
    """Solve N problems, each from its own prior (N, J); a NaN target (N, 3) gives the clipped prior.

    `terms` has one row for all, or N. No joint goes farther than `max_step` (J,) from the row before, or `previous`.
    """
    n, size = priors.shape
    scratch = ik_scratch(size)
    solutions, narrowed = np.empty((n, size)), arm.copy()
    for k in range(n):
        limit_step(arm, previous if k == 0 else solutions[k - 1], max_step, narrowed)
        own = terms[min(k, terms.shape[0] - 1)]
        solve_ik_one(narrowed, targets[k], priors[k], lambda_x, lambda_q, own, -1.0, solutions[k], scratch)
    return solutions


@njit(cache=True, fastmath=False)
def unreachable_one(arm, target, q, tolerance, spare, scratch):
    """Whether the descent of |target - f| alone from `q` inside the limits ends farther than `tolerance`; see `ik`."""
    solve_ik_one(arm, target, q, 1.0, 0.0, plain_terms(q.shape[0]), tolerance**2, spare, scratch)
    position, frames = scratch[1][0], scratch[2]
    arm_forward(arm, spare, frames[0], frames[1], position)
    apart = 0.0
    for i in range(3):
        apart += (position[i] - target[i]) ** 2
    return apart > tolerance**2  # False without a target


@njit(cache=True, fastmath=False)
def unreachable_batch(arm, targets, solutions, tolerance):
    """`unreachable_one` for each of N targets (N, 3) from its solution (N, J)."""
    n, size = solutions.shape
    scratch, spare, flags = ik_scratch(size), np.empty(size), np.empty(n, np.bool_)
    for k in range(n):
        flags[k] = unreachable_one(arm, targets[k], solutions[k], tolerance, spare, scratch)
    return flags
