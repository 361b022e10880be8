"""A schematic person, for what was not observed: proportions of stature after Drillis and Contini (1966)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mild_viz.dashboard.scene.shapes import Mesh, loft, merge, placed_ball, placed_limb

ARM_SHARE = 0.332
"""Shoulder to wrist, as a share of stature (upper arm 0.186, forearm 0.146)."""

SHOULDER_SHARE = 0.105
"""From the middle of the shoulders to a shoulder joint."""

COLLAR_SHARE = 0.818
"""Height of the shoulders above the floor."""

PELVIS_SHARE = 0.288
"""From the shoulders down to the hips."""

HEAD_SHARE = 0.128
"""From the shoulders up to the middle of the head."""

HEAD_RADIUS_SHARE = 0.066
"""From the middle of the head to its top."""

ANKLE_SHARE = 0.039


def stature(arm: Float[np.ndarray, "N 3 3"]) -> float:
    """Body height [m] that the length of the recorded arm suggests, kept to that of an adult."""
    length = np.linalg.norm(np.diff(arm, axis=1), axis=2).sum(1)
    length = length[np.isfinite(length)]
    return float(np.clip(np.median(length) / ARM_SHARE, 1.5, 1.95)) if len(length) else 1.7


def torso(height: float) -> Mesh:
    """Neck, chest and hips about the middle of the shoulders [m]: x forward, y left, z up."""
    sections = np.array(
        [  # z, half depth, half width, centre forward, centre left; all as shares of stature
            (-0.318, 0.030, 0.050, 0.0, 0.0),
            (-0.305, 0.052, 0.083, 0.0, 0.0),
            (-0.270, 0.060, 0.092, 0.0, 0.0),
            (-0.200, 0.052, 0.076, 0.002, 0.0),
            (-0.120, 0.062, 0.090, 0.006, 0.0),
            (-0.055, 0.064, 0.099, 0.006, 0.0),
            (-0.015, 0.052, 0.096, 0.002, 0.0),
            (0.010, 0.040, 0.072, -0.002, 0.0),
            (0.026, 0.031, 0.036, -0.004, 0.0),
            (0.040, 0.028, 0.030, -0.002, 0.0),
            (0.066, 0.027, 0.028, 0.002, 0.0),
        ]
    )
    return loft(sections * height)


def head(height: float) -> Mesh:
    """Head with a hint of a nose about its middle [m]."""
    skull = placed_ball(np.zeros(3), np.array([0.054, 0.045, 0.066]) * height)
    nose = placed_ball(np.array([0.053, 0.0, -0.010]) * height, np.array([0.010, 0.007, 0.013]) * height)
    return merge([skull, nose])


def left_arm(height: float) -> Mesh:
    """The other arm, hanging, about the middle of the shoulders [m]."""
    shoulder, elbow, wrist, fist = (
        np.array(point) * height
        for point in ((0.0, 0.112, -0.018), (-0.008, 0.130, -0.198), (0.030, 0.134, -0.340), (0.036, 0.134, -0.368))
    )
    return merge(
        [
            placed_limb(shoulder, elbow, 0.0265 * height),
            placed_limb(elbow, wrist, 0.0205 * height),
            placed_ball(fist, np.array([0.022, 0.016, 0.029]) * height),
        ]
    )


def legs(pelvis: Float[np.ndarray, " 3"], left: Float[np.ndarray, " 3"], floor: float, height: float) -> Mesh:
    """Two standing legs from the hips to the floor, in world [m]; `left` is the person's left."""
    forward = np.cross(left, [0.0, 0.0, 1.0])
    parts: list[Mesh] = []
    for side in (1.0, -1.0):
        hip = pelvis + side * 0.050 * height * left
        ankle = np.array([hip[0], hip[1], floor + 0.035 * height])
        knee = 0.48 * hip + 0.52 * ankle + 0.012 * height * forward
        parts += [placed_limb(hip, knee, 0.040 * height), placed_limb(knee, ankle, 0.028 * height, 0.6)]
        toe = ankle + 0.085 * height * forward
        parts.append(placed_limb(ankle, np.array([toe[0], toe[1], floor + 0.016 * height]), 0.022 * height))
    return merge(parts)


def stand(pelvis: Float[np.ndarray, " 3"], floor: float) -> Mesh:
    """A tailor's stand under a bust that hangs too low or too high for legs, in world [m]."""
    drop = floor - float(pelvis[2])
    sections = np.array(
        [
            (drop, 0.17, 0.17, 0.0, 0.0),
            (drop + 0.018, 0.165, 0.165, 0.0, 0.0),
            (drop + 0.03, 0.03, 0.03, 0.0, 0.0),
            (drop + 0.08, 0.016, 0.016, 0.0, 0.0),
            (-0.02, 0.016, 0.016, 0.0, 0.0),
        ]
    )
    vertices, faces = loft(sections)
    return vertices + pelvis, faces


def support(
    pelvis: Float[np.ndarray, " 3"], left: Float[np.ndarray, " 3"], floor: float, height: float, shortest: float = 0.85
) -> Mesh | None:
    """What carries the bust: legs where they would have a natural length, else a stand, or nothing to carry.

    `shortest` is the least share of the natural length.
    """
    share = (float(pelvis[2]) - floor) / ((COLLAR_SHARE - PELVIS_SHARE) * height)
    if shortest <= share <= 1.15:
        return legs(pelvis, left, floor, height)
    return stand(pelvis, floor) if share > 0.15 else None
