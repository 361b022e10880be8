"""From decoded joints to the command: contact gating, IK, smoothing, limits, stiffness, frame by frame.

One compiled loop with a carry serves both the whole trial and one observation at a time, so that both
give the same bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain, kernel_array
from mild_viz.robot.stiffness import contact_stiffness
from mild_viz.settings import CONTROLLERS, ControlSettings

MAX_STATES = 62
"""States that fit into a bit mask."""


class ControlCarry(NamedTuple):
    """What the controller remembers between frames of one interaction."""

    joints: Float[np.ndarray, " J"]
    """The previous command; the resting joints before the first one."""
    flags: Int[np.ndarray, "3"]
    """Whether a command was sent, how far it went, bit mask of the states seen before contact."""


class ControlResult(NamedTuple):
    """Commands for N frames."""

    joints: Float[np.ndarray, "N J"]
    """Commanded joints [rad], within the limits."""
    contact: Bool[np.ndarray, " N"]
    """Whether the most likely state is a contact state: this gates the IK (Algorithm vae-HMM-test)."""
    stiffness: Float[np.ndarray, "N J"]
    """Fraction of full joint stiffness."""
    carry: ControlCarry


def initial_carry(chain: ArmChain) -> ControlCarry:
    """The carry before the first frame: the arm rests."""
    return ControlCarry(np.array(chain.rest), np.zeros(3, dtype=np.int64))


def state_mask(states: frozenset[int], n_states: int) -> int:
    """Bit mask of a set of HMM states. Raises `UserError` for a state that the model does not have."""
    unknown = sorted(state for state in states if not 0 <= state < n_states)
    if unknown:
        raise UserError(f"contact state {unknown[0]} is unknown; valid: 0 to {n_states - 1}")
    if n_states > MAX_STATES:
        raise UserError(f"the model has {n_states} states; the controller takes up to {MAX_STATES}")
    return sum(1 << state for state in states)


def run_controller(
    chain: ArmChain,
    settings: ControlSettings,
    action: str,
    log_alpha: Float[np.ndarray, "N S"],
    decoded: Float[np.ndarray, "N J"],
    targets: Float[np.ndarray, "N 3"],
    carry: ControlCarry,
    log_transition: Float[np.ndarray, " N"] | None = None,
) -> ControlResult:
    """Commands for N frames from the forward variable, the decoded joints [rad] and the human's hand [m].

    Controllers: `mild` sends the decoded joints; `mild-ik` adapts them by IK in the contact states, with
    the decoded joints as prior (Algorithm vae-HMM-test); `base-ik` follows the hand at every frame by IK
    without a prior, from the previous command on (Eq. ik-plain). A NaN target means no IK in that frame.
    The command is smoothed by a weighted moving average, and never leaves the limits. In the contact of a
    handshake the stiffness is lowered; the segment that decides this never returns to a state that was
    active before the first contact (no back-transition to reaching).

    `log_transition` is the log probability of the transition state, which decides on the stiffness too: contact
    begins when either a contact state or it is more likely than the state of reaching, and while no contact state has
    been active yet, it counts as one (Sec. IK adaptation and stiffness modulation). The IK is gated by the most
    likely state alone, as Algorithm vae-HMM-test says. None, or -inf, means that there is no such state.

    The given carry is not changed; go on from the result's.
    """
    from mild_viz.robot.kernels import control_loop

    joints, flags = carry.joints.copy(), carry.flags.copy()
    commands, contact, stiffness = control_loop(
        chain.arm,
        CONTROLLERS.index(settings.controller),
        float(settings.lambda_x),
        float(settings.lambda_q),
        state_mask(settings.contact_states or frozenset(), log_alpha.shape[1]),
        float(settings.smoothing),
        contact_stiffness(action, settings.stiffness),
        kernel_array(log_alpha),
        np.full(len(log_alpha), -np.inf) if log_transition is None else kernel_array(log_transition),
        kernel_array(decoded),
        kernel_array(targets),
        joints,
        flags,
    )
    spread = np.repeat(stiffness[:, None], chain.n_joints, axis=1)
    return ControlResult(commands, contact, spread, ControlCarry(joints, flags))
