"""Joint angles of any robot arm from a person's shoulder, elbow and wrist: the hand's place is kept, by IK.

The person's wrist, seen from the shoulder, is scaled from the length of the person's arm to the robot's reach.
The IK's prior is the resting posture in every frame, not the last solution: the joints are then a function of where
the hand is, and do not drift through the postures that leave the hand in place. That is what a model can learn.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mild_viz.robot.chain import ArmChain
from mild_viz.robot.contact import arm_length
from mild_viz.robot.ik import solve_ik

LARGEST_FRACTION = 0.9
"""The robot uses this fraction of its reach at most, since a stretched arm cannot adapt."""

NEAREST, LOWEST = 0.32, 0.61
"""Fractions of its reach that a robot's hand stays before the axis through its shoulder, and above the depth below it:
where a person's arm hangs, a robot has its own base."""

PRIOR = 1e-4
"""Weight of the resting posture [m^2/rad^2]: it costs about 1 mm of the hand's place."""

MAX_RATE = 2.175
"""Fastest that a joint turns [rad/s]: what the slower motors of the Panda allow. A robot that reaches further than the
person would otherwise be faster in proportion, and a tracking error is no motion."""


def scaled_wrist(
    chain: ArmChain,
    arm: Float[np.ndarray, "T 3 3"],
    rotation: Float[np.ndarray, "3 3"],
    length: Float[np.ndarray, " T"] | float | None = None,
) -> Float[np.ndarray, "T 3"]:
    """Where the robot's hand is [m, base frame] if it stands to the robot's shoulder as the wrist to the person's.

    Direction and fraction of reach are kept, the latter up to `LARGEST_FRACTION`. `rotation` turns the person's frame
    into the robot's base frame, `length` is that of the person's arm [m] (default: its median over the frames). NaN
    where the arm was not tracked.
    """
    length = np.asarray(arm_length(arm) if length is None else length)[..., None]
    # einsum sums every row alike, however many there are: one frame alone gives the same bits
    reach = np.einsum("ij,nj->ni", rotation, arm[:, 2] - arm[:, 0]) / length
    fraction = np.linalg.norm(reach, axis=1, keepdims=True)
    along = reach / np.maximum(fraction, np.finfo(float).tiny)
    return chain.shoulder + chain.reach * np.minimum(fraction, LARGEST_FRACTION) * along


def retarget_arm(
    chain: ArmChain,
    arm: Float[np.ndarray, "T 3 3"],
    rate: float,
    rotation: Float[np.ndarray, "3 3"] | None = None,
    *,
    length: Float[np.ndarray, " T"] | float | None = None,
    previous: Float[np.ndarray, " J"] | None = None,
) -> Float[np.ndarray, "T J"]:
    """Joints [rad] of T frames of shoulder, elbow, wrist [m] at `rate` [Hz], within the limits and `MAX_RATE`.

    `rotation` turns the person's frame (x forward, y left, z up) into the robot's base frame; None: they are equal.
    Only the wrist counts, not the elbow. Frames in which the arm was not tracked (NaN) give NaN, and the motion
    begins anew after them. (Eq. ik-prior-simplified with the resting posture as prior.)

    All frames at once or one by one gives the same bits, if `length`, that of the person's arm, is given [m] (default:
    its median over the frames), and as `previous` the joints of the frame before (NaN, or None: there is none).
    """
    targets = _before_the_base(chain, scaled_wrist(chain, arm, np.eye(3) if rotation is None else rotation, length))
    joints = solve_ik(chain, targets, np.tile(chain.rest, (len(arm), 1)), 1.0, PRIOR)
    joints[np.isnan(arm).any(axis=(1, 2)) | np.isnan(targets).any(axis=1)] = np.nan
    step = MAX_RATE / rate
    last = previous
    for now in joints:
        if last is not None and np.isfinite(last).all():
            now[:] = last + np.clip(now - last, -step, step)
        last = now
    return joints


def _before_the_base(chain: ArmChain, targets: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Targets moved forward until they are clear of the robot's own base, and up until they are clear of the floor."""
    x, y, z = (targets - chain.shoulder).T
    x = np.maximum(x, np.sqrt(np.maximum((NEAREST * chain.reach) ** 2 - y**2, 0.0)))
    return chain.shoulder + np.stack([x, y, np.maximum(z, -LOWEST * chain.reach)], axis=1)
