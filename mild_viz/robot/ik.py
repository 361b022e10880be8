"""Inverse kinematics with a joint prior: Eq. ik-prior-simplified inside the joint limits."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mild_viz.robot.chain import ArmChain, kernel_array


def solve_ik(
    chain: ArmChain,
    targets: Float[np.ndarray, "N 3"],
    priors: Float[np.ndarray, "N J"],
    lambda_x: float = 1.0,
    lambda_q: float = 0.01,
) -> Float[np.ndarray, "N J"]:
    """argmin over q of lambda_x |target - f(q)|^2 + lambda_q |prior - q|^2 (Eq. ik-prior-simplified).

    Targets [m] in the base frame, priors [rad]; each row starts from its own prior (moved inside the limits
    where it is outside) and ends in the stationary point below it, never in a worse one. It does not look
    for a better optimum elsewhere, because a robot must move continuously. NaN targets give the prior.
    """
    from mild_viz.robot.kernels import solve_ik_batch

    return solve_ik_batch(chain.arm, kernel_array(targets), kernel_array(priors), float(lambda_x), float(lambda_q))


def forward(chain: ArmChain, joints: Float[np.ndarray, "N J"]) -> Float[np.ndarray, "N 3"]:
    """End effector position f(q) [m] in the base frame at N joint vectors [rad]."""
    from mild_viz.robot.kinematics.kernels import kinematics_batch

    return kinematics_batch(chain.arm, kernel_array(joints))[0]


def jacobian(chain: ArmChain, joints: Float[np.ndarray, "N J"]) -> Float[np.ndarray, "N J 3"]:
    """Derivative of `forward` by each joint [m/rad]."""
    from mild_viz.robot.kinematics.kernels import kinematics_batch

    return kinematics_batch(chain.arm, kernel_array(joints))[1]
