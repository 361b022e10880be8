"""Inverse kinematics with a joint prior: Eq. ik-prior-simplified inside the joint limits."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.robot.chain import ArmChain, kernel_array
from mild_viz.robot.objective.terms import IKTerms


def solve_ik(
    chain: ArmChain,
    targets: Float[np.ndarray, "N 3"],
    priors: Float[np.ndarray, "N J"],
    lambda_x: float = 1.0,
    lambda_q: float = 0.01,
    *,
    terms: IKTerms | None = None,
) -> Float[np.ndarray, "N J"]:
    """argmin over q of lambda_x |target - f(q)|^2 + lambda_q |prior - q|^2 (Eq. ik-prior-simplified), and `terms`.

    Targets [m] in the base frame, priors [rad]; each row starts from its own prior (moved inside the limits
    where it is outside) and ends in the stationary point below it, never in a worse one. It does not look
    for a better optimum elsewhere, because a robot must move continuously. NaN targets give the prior.

    With `terms.max_step`, the rows are frames of one motion: each is solved inside the box of that size around the
    solution before it, and the limits. A NaN prior gives NaN, after which the motion begins anew.

    A target beyond reach is approached as near as the weights allow; `unreachable` tells.

    Raises:
        UserError: if the terms do not fit the arm or the number of targets.
    """
    from mild_viz.robot.kernels import solve_ik_batch

    asked = _no_terms(chain.n_joints) if terms is None else (terms.packed(chain, len(targets)), *terms.steps(chain))
    return solve_ik_batch(
        chain.arm, kernel_array(targets), kernel_array(priors), float(lambda_x), float(lambda_q), *asked
    )


@cache
def _no_terms(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the kernel takes where there are no terms: made once, because it takes as long as a third of the solving."""
    from mild_viz.robot.objective.kernels import plain_terms

    return plain_terms(n)[None], np.full(n, np.inf), np.full(n, np.nan)


def unreachable(
    chain: ArmChain,
    targets: Float[np.ndarray, "N 3"],
    solutions: Float[np.ndarray, "N J"],
    tolerance: float = 1e-3,
) -> Bool[np.ndarray, " N"]:
    """Whether the joint limits, and not the prior or another term, keep the hand from its target.

    True where the descent of |target - f(q)|^2 alone, from the solution on and inside the joint limits, still ends
    farther than `tolerance` [m] from the target: beyond reach, or beyond what the limits admit on this side of the
    posture (another posture may do it). False for every other distance, which the weights or the velocity limits
    account for, and for a NaN target.
    """
    from mild_viz.robot.kernels import unreachable_batch

    return unreachable_batch(chain.arm, kernel_array(targets), kernel_array(solutions), float(tolerance))


def forward(chain: ArmChain, joints: Float[np.ndarray, "N J"]) -> Float[np.ndarray, "N 3"]:
    """End effector position f(q) [m] in the base frame at N joint vectors [rad]."""
    from mild_viz.robot.kinematics.kernels import kinematics_batch

    return kinematics_batch(chain.arm, kernel_array(joints))[0]


def jacobian(chain: ArmChain, joints: Float[np.ndarray, "N J"]) -> Float[np.ndarray, "N J 3"]:
    """Derivative of `forward` by each joint [m/rad]."""
    from mild_viz.robot.kinematics.kernels import kinematics_batch

    return kinematics_batch(chain.arm, kernel_array(joints))[1]
