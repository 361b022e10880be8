"""Joint angles of any robot arm from a person's shoulder, elbow and wrist: the hand's place is kept, by IK.

The person's wrist, seen from the shoulder, is scaled from the length of the person's arm to the robot's reach. What a
`PositionRule` of its robot.toml says beside it: how the hand is held, and where the elbow lies.

The IK's prior is the resting posture in every frame, not the last solution: the joints are then a function of where
the hand and the elbow are, and do not drift through the postures that leave the hand in place. That is what a model
can learn. Only where a joint would turn faster than `MAX_RATE`, the last solution counts: the IK then finds the best
posture that can be reached in time.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.robot.chain import ArmChain
from mild_viz.robot.contact import arm_length
from mild_viz.robot.ik import solve_ik
from mild_viz.robot.objective.terms import IKTerms

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

UP = np.array([0.0, 0.0, 1.0])


def scaled_wrist(
    chain: ArmChain,
    arm: Float[np.ndarray, "T 3 3"],
    rotation: Float[np.ndarray, "3 3"],
    length: Float[np.ndarray, " T"] | float | None = None,
) -> Float[np.ndarray, "T 3"]:
    """Where the robot's hand is [m, base frame] if it stands to the robot's shoulder as the wrist to the person's.

    Direction and fraction of reach are kept, but for the lift of the arm's rule; the latter up to `LARGEST_FRACTION`.
    `rotation` turns the person's frame into the robot's base frame, `length` is that of the person's arm [m] (default:
    its median over the frames). NaN where the arm was not tracked.
    """
    length = np.asarray(arm_length(arm) if length is None else length)[..., None]
    return hand_place(chain, _turned(rotation, arm[:, 2] - arm[:, 0]) / length)


def hand_place(chain: ArmChain, reach: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Where the robot's hand is [m, base frame] for a hand this far from the shoulder, as a share of the arm's length.

    Direction and share are kept, but for the lift of the arm's rule; the latter up to `LARGEST_FRACTION`.
    """
    reach = reach + chain.position.lift / chain.reach * UP
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
    The arm's `PositionRule` says how hand and elbow are held. Frames in which the arm was not tracked (NaN) give NaN,
    and the motion begins anew after them. (Eq. ik-prior-simplified with the resting posture as prior, and the terms of
    `IKTerms`.)

    All frames at once or one by one gives the same bits, if `length`, that of the person's arm, is given [m] (default:
    its median over the frames), and as `previous` the joints of the frame before (NaN, or None: there is none).
    """
    rotation = np.eye(3) if rotation is None else rotation
    targets = _before_the_base(chain, scaled_wrist(chain, arm, rotation, length))
    seen = np.logical_and.reduce(np.isfinite(np.concatenate([arm.reshape(-1, 9), targets], axis=1)), axis=1)
    return from_rest(chain, targets, seen, _held(chain, targets, _turned(rotation, arm), rate, previous))


def largest_step(chain: ArmChain, rate: float) -> Float[np.ndarray, " J"]:
    """How far each joint turns from one frame to the next at most [rad]."""
    return np.minimum(MAX_RATE, chain.velocity) / rate


def from_rest(
    chain: ArmChain, targets: Float[np.ndarray, "T 3"], seen: Bool[np.ndarray, " T"], terms: IKTerms
) -> Float[np.ndarray, "T J"]:
    """Joints [rad] that bring the hand to targets [m], near the resting posture; NaN where not `seen`."""
    priors = np.where(seen[:, None], chain.rest, np.nan)  # without a prior there is no solution
    return solve_ik(chain, targets, priors, 1.0, PRIOR, terms=terms)


def _turned(rotation: Float[np.ndarray, "3 3"], points: Float[np.ndarray, "*T 3"]) -> Float[np.ndarray, "*T 3"]:
    """Points turned into another frame. einsum sums every row alike: one frame alone gives the same bits."""
    return np.einsum("ij,...j->...i", rotation, points)


def _held(
    chain: ArmChain,
    targets: Float[np.ndarray, "T 3"],
    arm: Float[np.ndarray, "T 3 3"],
    rate: float,
    previous: Float[np.ndarray, " J"] | None,
) -> IKTerms:
    """The terms of the arm's rule for hands at `targets`; `arm` is the person's, turned into the base frame."""
    rule = chain.position
    outward = _unit((targets - chain.shoulder) * (1.0, 1.0, 0.0))
    across = np.cross(UP, outward)
    line, upper = _unit(arm[:, 2] - arm[:, 0]), _unit(arm[:, 1] - arm[:, 0])
    off = upper - np.sum(upper * line, axis=1, keepdims=True) * line
    aside = rule.side * np.sum(off * across, axis=1, keepdims=True)
    return IKTerms(
        orientation_weight=rule.level_weight,
        tool_axis=np.array(rule.tool_axis),
        tool_direction=outward,
        elbow_weight=rule.elbow_weight,
        elbow_joint=chain.elbow,
        elbow_direction=rule.lean * outward + rule.rise * UP + aside * across,
        joint_weights=np.array(rule.joint_weights) if rule.joint_weights else None,
        max_step=largest_step(chain, rate),
        previous=previous,
    )


def _unit(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """The vectors divided by their length; one of length 0 stays so."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)


def _before_the_base(chain: ArmChain, targets: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Targets moved forward until they are clear of the robot's own base, and up until they are clear of the floor."""
    x, y, z = (targets - chain.shoulder).T
    x = np.maximum(x, np.sqrt(np.maximum((NEAREST * chain.reach) ** 2 - y**2, 0.0)))
    return chain.shoulder + np.stack([x, y, np.maximum(z, -LOWEST * chain.reach)], axis=1)
