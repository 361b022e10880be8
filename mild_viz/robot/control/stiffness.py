"""Joint stiffness: full in free motion, lowered where a hand is shaken, and never changed at once."""

from __future__ import annotations

from typing import NamedTuple

from mild_viz.robot.control.rules import ContactRules
from mild_viz.robot.spec import StiffnessSpec


class StiffnessSchedule(NamedTuple):
    """The stiffness in and out of contact as fractions of full stiffness, and how fast it falls and rises [1/s]."""

    free: float
    contact: float
    fall: float
    rise: float


def stiffness_schedule(rules: ContactRules, enabled: bool, limits: StiffnessSpec) -> StiffnessSchedule:
    """What the rules of an action ask for, within what the robot takes."""
    free = limits.highest
    contact = min(max(rules.stiffness, limits.lowest), free) if enabled and rules.compliant else free
    return StiffnessSchedule(
        free, contact, min(rules.stiffness_fall, limits.rate), min(rules.stiffness_rise, limits.rate)
    )
