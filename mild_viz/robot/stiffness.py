"""Joint stiffness: high in free motion, lowered while a hand is being shaken."""

from __future__ import annotations

FREE_STIFFNESS = 1.0
"""Fraction of full joint stiffness in free motion."""

HANDSHAKE_STIFFNESS = 0.4
"""Fraction of full joint stiffness in the contact of a handshake.

Our choice: the paper says that the stiffness is lowered, and gives no value. It is low enough that a hand
moves Pepper's arm, and high enough that the arm does not sink under its own weight.
"""

COMPLIANT_ACTIONS = ("handshake",)
"""Actions in which the robot must give way in contact (Sec. IK adaptation and stiffness modulation)."""


def contact_stiffness(action: str, enabled: bool) -> float:
    """Stiffness in contact, as a fraction of full stiffness."""
    return HANDSHAKE_STIFFNESS if enabled and action in COMPLIANT_ACTIONS else FREE_STIFFNESS
