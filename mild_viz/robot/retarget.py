"""Joint angles of Pepper's right arm from a person's shoulder, elbow and wrist."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

SMALLEST, LARGEST = 0.0087, 1.562
"""Range of the elbow's and the shoulder's roll [rad], as the authors clip it."""


def retarget_pepper(arm: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, "T 4"]:
    """RShoulderPitch, RShoulderRoll, RElbowYaw, RElbowRoll [rad] of T frames of shoulder, elbow, wrist [m].

    The person's frame has x forward, y left, z up. Frames in which a joint is missing (NaN), or in which
    the upper arm or the forearm has no length, give NaN. (Sec. IK adaptation, after Fritsche et al.)
    """
    upper, fore = arm[:, 1] - arm[:, 0], arm[:, 2] - arm[:, 1]
    upper_length, fore_length = np.linalg.norm(upper, axis=1), np.linalg.norm(fore, axis=1)
    usable = (upper_length > 0.0) & (fore_length > 0.0)  # False for NaN too
    angles = np.full((len(arm), 4), np.nan)
    u, f = upper[usable], fore[usable]
    u_length, f_length = upper_length[usable], fore_length[usable]

    elbow = np.clip(_angle(u, f), SMALLEST, LARGEST)
    roll = np.clip(np.arcsin(np.clip(np.minimum(u[:, 1], -SMALLEST) / u_length, -1.0, 1.0)), -LARGEST, -SMALLEST)
    pitch = np.arctan2(np.maximum(u[:, 0], 0.0), u[:, 2]) - np.pi / 2
    # forearm as the three angles so far put it: R_y(pitch) R_z(roll) R_z(elbow) (|f|, 0, 0)
    turned = roll + elbow
    rebuilt = np.stack(
        [np.cos(pitch) * np.cos(turned), np.sin(turned), -np.sin(pitch) * np.cos(turned)], axis=1
    ) * f_length[:, None]  # fmt: skip
    angles[usable] = np.stack([pitch, roll, _angle(f, rebuilt), elbow], axis=1)
    return angles


def _angle(a: Float[np.ndarray, "T 3"], b: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, " T"]:
    """Angle between vectors [rad]; accurate and defined for parallel ones too."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
