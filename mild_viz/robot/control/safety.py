"""The limits of the safety filter, the last stage of every command (`kernels.control_loop`).

Whatever is wanted, a command keeps the joints inside their limits less a margin, never moves them faster or changes
their velocity faster than they may, and always leaves a way to stop before a limit, at whatever times the next commands
are sent. With q_k the command after dt_k:

    v_k = (q_k - q_{k-1}) / dt_k,   |v_k| <= velocity,   |v_k - v_{k-1}| <= acceleration dt_k,
    lower <= q_k + v_k |v_k| / (2 acceleration) <= upper

A motion that does so passes unchanged, to the bit. `settings.Watch` says when the robot stops where it is, because what
was seen of the human is too old or cannot be, and when it returns to rest, because the human is gone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.spec import SafetySpec
from mild_viz.trial import freeze_arrays

UNSTATED_VELOCITY = 3.14
"""Largest speed of a joint whose description states none [rad/s]: half a turn a second."""

RISE_TIME = 0.1
"""A joint gets up to its largest speed in this time [s], where its largest acceleration is not known.

Pepper's shoulder then has 73 rad/s^2: about as much as the frame differences of recorded people, retargeted at 30 Hz,
reach in 5 % of the frames. The Panda has 22-26 rad/s^2, where its maker allows 7.5-20.
"""


@dataclass(frozen=True, eq=False)
class Limits:
    """What the safety filter holds each of J joints to."""

    lower: Float[np.ndarray, " J"]
    """Smallest command [rad], the margin included."""
    upper: Float[np.ndarray, " J"]
    velocity: Float[np.ndarray, " J"]
    """Largest speed [rad/s]."""
    acceleration: Float[np.ndarray, " J"]
    """Largest change of the velocity [rad/s^2]."""
    rest: Float[np.ndarray, " J"]
    """Where the joints go when the human is gone [rad]."""

    def __post_init__(self) -> None:
        for name in ("velocity", "acceleration"):
            values = getattr(self, name)
            if not (np.isfinite(values) & (values > 0.0)).all():
                raise UserError(f"{name} is {values.tolist()}; valid: a finite number above 0 for every joint")
        if not ((self.lower <= self.rest) & (self.rest <= self.upper)).all():
            raise UserError(f"rest is {self.rest.tolist()}; valid: from {self.lower.tolist()} to {self.upper.tolist()}")
        freeze_arrays(self)


def limits_of(chain: ArmChain, spec: SafetySpec) -> Limits:
    """The limits of an arm [rad, rad/s, rad/s^2]: its description's, and its robot's margin and acceleration.

    The resting posture is inside, and so is the middle half of a joint that hardly moves.
    """
    rest = np.clip(chain.rest, chain.lower, chain.upper)
    margins = np.minimum(spec.margin, 0.25 * (chain.upper - chain.lower))
    velocity = np.where(np.isfinite(chain.velocity), chain.velocity, UNSTATED_VELOCITY)
    return Limits(
        np.minimum(chain.lower + margins, rest),
        np.maximum(chain.upper - margins, rest),
        velocity,
        velocity / RISE_TIME if spec.acceleration is None else np.full(chain.n_joints, spec.acceleration),
        rest,
    )
