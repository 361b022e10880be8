"""Bodies of the demo set: how long limbs are, and where every joint lies for a given motion of the right hand.

Segment lengths are fractions of stature after Drillis and Contini (1966), as tabled in Winter, Biomechanics and
Motor Control of Human Movement (fig. 4.1). Three fractions are ours, because depth cameras track joint centres
where that table gives landmarks of the skin: half the shoulder width (biacromial width less about 3 cm a side),
the waist and the head's centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mild_viz.data.skeletons import NUITRACK_JOINTS, bones_along

DEMO_JOINTS = (
    *NUITRACK_JOINTS,
    "left_hip", "left_knee", "left_ankle", "right_hip", "right_knee", "right_ankle",
)  # fmt: skip
"""Nuitrack's upper body, and the legs, so that the people stand on the floor."""

DEMO_BONES = bones_along(
    DEMO_JOINTS,
    "head neck right_collar torso waist",
    "left_collar left_shoulder left_elbow left_wrist left_hand",
    "right_collar right_shoulder right_elbow right_wrist right_hand",
    "waist left_hip left_knee left_ankle",
    "waist right_hip right_knee right_ankle",
)

GRIP = 0.40
"""From the wrist to the middle of the palm, as a fraction of hand length; the skeleton's hand joint, and the
point at which two hands hold each other in a handshake."""
FIST = 0.50
"""From the wrist to the knuckles of a closed fist, as a fraction of hand length; the point that touches in a bump."""

SEGMENTS = {
    "collar_height": 0.818,
    "waist_height": 0.565,
    "torso_height": 0.680,
    "neck": 0.050,
    "head": 0.065,
    "half_shoulders": 0.100,
    "upper_arm": 0.186,
    "forearm": 0.146,
    "hand": 0.108,
    "hip_height": 0.530,
    "half_hips": 0.0525,
    "thigh": 0.245,
    "shank": 0.246,
    "ankle_height": 0.039,
}
"""Length or height of each segment as a fraction of stature."""


@dataclass(frozen=True)
class Person:
    """One member of the cast: limbs [m] and the habits that stay with a person over trials."""

    stature: float
    lengths: dict[str, float]
    """Keys of `SEGMENTS` [m]."""
    tempo: float
    """Multiplies this person's movement times, about 1."""
    vigour: float
    """Multiplies amplitudes and how much the trunk takes part, about 1."""
    rest_hand: tuple[float, float]
    """Forward and outward component of shoulder-to-hand per unit of drop, of an arm that hangs."""
    rest_flexion: float
    """Elbow flexion of a hanging arm [rad]."""


def make_person(rng: np.random.Generator, stature: float) -> Person:
    """Draw a person of this stature [m]: segments vary by about 2 % about the table, both sides alike."""
    factors = np.clip(rng.normal(1.0, 0.02, len(SEGMENTS)), 0.955, 1.045)
    # Heights of landmarks vary less than limbs do: their errors would add up in the trunk's length.
    lengths = {
        name: stature * ratio * (1 + (factor - 1) * (0.3 if name.endswith("height") else 1.0))
        for (name, ratio), factor in zip(SEGMENTS.items(), factors.tolist(), strict=True)
    }
    # The legs must reach the floor from this person's own hips, with knees that are never locked.
    stretch = (lengths["hip_height"] - lengths["ankle_height"]) * 1.006 / (lengths["thigh"] + lengths["shank"])
    lengths["thigh"] *= stretch
    lengths["shank"] *= stretch
    tempo, vigour, forward, outward, flexion = rng.uniform(
        [0.90, 0.85, 0.06, 0.10, np.radians(16)], [1.12, 1.15, 0.18, 0.19, np.radians(28)]
    ).tolist()
    return Person(stature, lengths, tempo, vigour, (forward, outward), flexion)


@dataclass(frozen=True)
class ArmMotion:
    """What the right hand does. Everything in the person's body frame: origin on the floor between the feet,
    x the way the person faces, y left, z up [m]."""

    share: Float[np.ndarray, " T"]
    """0: the arm hangs; 1: the hand is at `goal`; the minimum-jerk course of reaching and returning."""
    goal: Float[np.ndarray, "T 3"]
    """Where the touching point of the hand goes, or, with `from_shoulder`, where seen from the shoulder."""
    from_shoulder: bool
    detour: Float[np.ndarray, " 3"]
    """How far the middle of the way to and from the goal lies off the straight line."""
    elbow: Float[np.ndarray, "T 3"]
    """Direction in which the elbow points at the goal; at rest it points backwards."""
    touch: float
    """From the wrist to the point of the hand that touches, as a fraction of hand length (`GRIP` or `FIST`)."""


def two_link(
    root: Float[np.ndarray, "T 3"],
    target: Float[np.ndarray, "T 3"],
    first: float,
    second: float,
    pole: Float[np.ndarray, "T 3"],
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, "T 3"]]:
    """Middle joint and unit direction of the second link of a two-link chain that reaches from root to target.

    `first`, `second` are link lengths [m]. The middle joint lies on the side of `pole`. A target out of reach is
    approached along its own direction, so link lengths are exact always.
    """
    axis = target - root
    distance = np.linalg.norm(axis, axis=-1, keepdims=True)
    axis = axis / distance
    distance = np.clip(distance, abs(first - second) + 1e-3, 0.9995 * (first + second))
    along = (first**2 - second**2 + distance**2) / (2 * distance)
    side = pole - np.sum(pole * axis, axis=-1, keepdims=True) * axis
    side = side / np.linalg.norm(side, axis=-1, keepdims=True)
    middle = root + along * axis + np.sqrt(first**2 - along**2) * side
    return middle, (root + distance * axis - middle) / second


def turned(
    yaw: Float[np.ndarray, " T"], lean: Float[np.ndarray, " T"], vector: Float[np.ndarray, "#T 3"]
) -> Float[np.ndarray, "T 3"]:
    """A vector leaned forward by `lean`, then turned left by `yaw` [rad]."""
    forward = np.cos(lean) * vector[:, 0] + np.sin(lean) * vector[:, 2]
    up = np.cos(lean) * vector[:, 2] - np.sin(lean) * vector[:, 0]
    left = vector[:, 1]
    return np.stack([np.cos(yaw) * forward - np.sin(yaw) * left, np.sin(yaw) * forward + np.cos(yaw) * left, up], -1)


def wander(
    rng: np.random.Generator, times: Float[np.ndarray, " T"], sizes: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "N T"]:
    """Slow aimless movements of standard deviation `sizes`: postural sway, 0.1 to 0.6 Hz."""
    rates = rng.uniform([0.10, 0.22, 0.40], [0.20, 0.38, 0.60], (len(sizes), 3))
    starts = rng.uniform(0, 2 * np.pi, (len(sizes), 3))
    weights = np.array([1.0, 0.7, 0.3]) / np.sqrt((1.0**2 + 0.7**2 + 0.3**2) / 2)
    waves = np.sin(2 * np.pi * rates[:, :, None] * times + starts[:, :, None])
    return sizes[:, None] * np.sum(weights[:, None] * waves, axis=1)


SWAY = {
    "yaw": np.radians(0.8),
    "lean": np.radians(0.4),
    "waist_x": 0.005,
    "waist_y": 0.006,
    "nod": np.radians(1.5),
    "gaze": np.radians(2.0),
    "right_x": 0.006,
    "right_y": 0.003,
    "left_x": 0.008,
    "left_y": 0.004,
}
"""Standard deviations of what never stands quite still: trunk, head, hanging hands [rad or m]."""


def hanging(person: Person, second: float, side: float) -> Float[np.ndarray, " 3"]:
    """From shoulder to the end of a hanging arm whose second link is `second` long; side +1 left, -1 right."""
    first = person.lengths["upper_arm"]
    reach = np.sqrt(first**2 + second**2 + 2 * first * second * np.cos(person.rest_flexion))
    direction = np.array([person.rest_hand[0], side * person.rest_hand[1], -1.0])
    return reach * direction / np.linalg.norm(direction)


def body_joints(
    rng: np.random.Generator, person: Person, times: Float[np.ndarray, " T"], arm: ArmMotion
) -> tuple[Float[np.ndarray, "T 20 3"], Float[np.ndarray, "T 3"]]:
    """All `DEMO_JOINTS` and the right hand's touching point over time, in the body frame of `ArmMotion` [m].

    The trunk leans, turns and protracts its shoulder as far as the goal asks for it; the left arm hangs and sways.
    """
    size, n = person.lengths, len(times)
    trunk = size["collar_height"] - size["waist_height"]
    link = size["forearm"] + arm.touch * size["hand"]
    share = arm.share

    # How much the trunk takes part: a goal near the shoulder needs none, one at 0.95 of the arm's length much.
    shoulder_at_rest = np.array([0.0, -size["half_shoulders"], size["collar_height"]])
    away = arm.goal if arm.from_shoulder else arm.goal - shoulder_at_rest
    stretch = np.linalg.norm(away, axis=-1) / (size["upper_arm"] + link)
    effort = share * person.vigour / (1 + np.exp(-(stretch - 0.93) / 0.05))
    high = share * np.clip(away[:, 2] / 0.3 + 1.0, 0.0, 1.5)

    sway = dict(zip(SWAY, wander(rng, times, np.array(list(SWAY.values()))), strict=True))
    breath = np.sin(2 * np.pi * rng.uniform(0.22, 0.30) * times + rng.uniform(0, 2 * np.pi))
    yaw = np.radians(15) * effort + sway["yaw"]
    lean = np.radians(5) * effort + sway["lean"] - np.radians(0.15) * breath
    waist = np.stack([sway["waist_x"], sway["waist_y"], np.full(n, size["waist_height"])], axis=-1)
    collar = waist + turned(yaw, lean, np.array([[0.0, 0.0, trunk]]))
    torso = waist + turned(0.7 * yaw, lean, np.array([[-0.012, 0.0, size["torso_height"] - size["waist_height"]]]))
    neck = collar + turned(yaw, lean, np.array([[0.004, 0.0, size["neck"]]]))
    # The head stays with the partner's face while the trunk turns, and glances down at hands that meet low.
    nod = 0.6 * lean + np.radians(9) * share * np.clip(1 - high, 0, 1) + sway["nod"]
    gaze = 0.3 * yaw + sway["gaze"]
    head = neck + turned(gaze, nod, np.array([[0.006, 0.0, size["head"]]]))

    # Each clavicle turns forward and up about the collar; the reaching side far, the other a little back.
    def clavicle(protraction: np.ndarray, elevation: np.ndarray, side: float) -> np.ndarray:
        along = np.cos(elevation)
        out = np.stack([along * np.sin(protraction), side * along * np.cos(protraction), np.sin(elevation)], axis=-1)
        return collar + turned(yaw, lean, size["half_shoulders"] * out)

    lift = np.radians(0.8) * breath
    right_shoulder = clavicle(np.radians(16) * effort, lift + np.radians(6) * high, -1.0)
    left_shoulder = clavicle(np.radians(-3) * effort, lift, 1.0)

    # Right arm: hand from hanging to goal; forearm and hand are one straight link up to the touching point.
    rest = right_shoulder + hanging(person, link, -1.0)
    rest = rest + np.stack([sway["right_x"], sway["right_y"], np.zeros(n)], axis=-1)
    goal = right_shoulder + arm.goal if arm.from_shoulder else arm.goal
    hand_way = rest + share[:, None] * (goal - rest) + (4 * share * (1 - share))[:, None] * arm.detour
    # The elbow comes up after the hand: it leaves its hanging side late, and is back there early.
    late = share[:, None] ** 2
    pole = (1 - late) * np.array([-1.0, -0.25, -0.2]) + late * arm.elbow
    right_elbow, forearm = two_link(right_shoulder, hand_way, size["upper_arm"], link, pole)
    right_wrist = right_elbow + size["forearm"] * forearm
    right_hand = right_wrist + GRIP * size["hand"] * forearm

    # Left arm: hangs, and swings a little against the turning trunk.
    left_link = size["forearm"] + GRIP * size["hand"]
    left_way = left_shoulder + hanging(person, left_link, 1.0)
    left_way = left_way + np.stack(
        [sway["left_x"] - 0.03 * effort, sway["left_y"] + 0.015 * effort, np.zeros(n)], axis=-1
    )
    pole = np.tile([-1.0, 0.25, -0.2], (n, 1))
    left_elbow, left_forearm = two_link(left_shoulder, left_way, size["upper_arm"], left_link, pole)
    left_wrist = left_elbow + size["forearm"] * left_forearm
    left_hand = left_wrist + GRIP * size["hand"] * left_forearm

    joints = [head, neck, torso, waist, collar, left_shoulder, left_elbow, left_wrist, left_hand]
    joints += [collar, right_shoulder, right_elbow, right_wrist, right_hand]
    for side in (1.0, -1.0):
        hip = waist + np.array([0.0, side * size["half_hips"], size["hip_height"] - size["waist_height"]])
        ankle = np.tile([-0.02, side * 1.25 * size["half_hips"], size["ankle_height"]], (n, 1))
        knee, shank = two_link(hip, ankle, size["thigh"], size["shank"], np.tile([1.0, 0.0, 0.0], (n, 1)))
        joints += [hip, knee, knee + size["shank"] * shank]
    return np.stack(joints, axis=1), right_elbow + link * forearm
