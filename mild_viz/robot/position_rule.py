"""How an arm takes over a person's posture, beside the place of the hand: a part of robot.toml."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PositionRule:
    """What `retarget_arm` asks of an arm; as it stands: nothing but the place of the hand.

    Both directions are relative to the vertical plane through shoulder and hand, in which most arms work: turned
    with it, they ask as little of the joints as can be, and leave more for a model to learn.
    """

    lift: float = 0.0
    """How much higher the hand is than direction and fraction of reach say [m]: a robot without a torso stands lower
    beside a person than its shoulder would have to."""
    level_weight: float = 0.0
    """Weight of holding the hand level, and pointing away from the shoulder [m^2/rad^2]."""
    tool_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Where the hand points, in the frame of the end effector."""
    elbow_weight: float = 0.0
    """Weight of the elbow's direction [m^2]; the arm names the joint that is its elbow."""
    lean: float = 0.0
    """The elbow's direction from the shoulder: this much towards the hand,"""
    rise: float = 0.0
    """this much up,"""
    side: float = 0.0
    """and this much of how far the person's elbow stands out of that plane, in lengths of the upper arm."""
    joint_weights: tuple[float, ...] = ()
    """What each joint costs that strays from the resting posture; empty: 1."""
