"""Franka Emika Panda with its hand: joints, and the shapes of the links, each in its link's frame."""

from __future__ import annotations

import numpy as np
from modelling.description import ZERO, Joint, Y, Z
from modelling.palette import BLACK, DARK, GREY, LED, LIGHT, WHITE
from modelling.round import band, lathe, limb
from modelling.surfaces import Y_AXIS, Colour, Loft, Piece, body, rim, slab

ROOT = "world"
SHARED: dict[str, str] = {}

UP, DOWN = ("1.57079632679", "0", "0"), ("-1.57079632679", "0", "0")
STRONG, WEAK = ("87", "2.1750"), ("12", "2.6100")  # effort, velocity of joints 1-4 and 5-7
FULL = ("-2.8973", "2.8973")
FINGER = ("-0.001", "0.04", "20", "0.3")


def link(number: int) -> str:
    return f"panda_link{number}"


JOINTS = [
    Joint("panda_joint_world", "world", link(0), ZERO),
    Joint("panda_joint1", link(0), link(1), ("0", "0", "0.333"), ZERO, Z, (*FULL, *STRONG)),
    Joint("panda_joint2", link(1), link(2), ZERO, DOWN, Z, ("-1.7628", "1.7628", *STRONG)),
    Joint("panda_joint3", link(2), link(3), ("0", "-0.316", "0"), UP, Z, (*FULL, *STRONG)),
    Joint("panda_joint4", link(3), link(4), ("0.0825", "0", "0"), UP, Z, ("-3.0718", "0.0698", *STRONG)),
    Joint("panda_joint5", link(4), link(5), ("-0.0825", "0.384", "0"), DOWN, Z, (*FULL, *WEAK)),
    Joint("panda_joint6", link(5), link(6), ZERO, UP, Z, ("-0.0175", "3.7525", *WEAK)),
    Joint("panda_joint7", link(6), link(7), ("0.088", "0", "0"), UP, Z, (*FULL, *WEAK)),
    Joint("panda_joint8", link(7), link(8), ("0", "0", "0.107")),
    Joint("panda_hand_joint", link(8), "panda_hand", ZERO, ("0", "0", "-0.785398163397")),
    Joint("panda_finger_joint1", "panda_hand", "panda_leftfinger", ("0", "0", "0.0584"), ZERO, Y, FINGER, slides=True),
    Joint("panda_finger_joint2", "panda_hand", "panda_rightfinger", ("0", "0", "0.0584"), ZERO, ("0", "-1", "0"),
          FINGER, slides=True),
    Joint("end_effector_frame_fixed_joint", link(7), "end_effector_frame", ("0", "0", "0.21"),
          ("3.14159", "-1.57079", "-0.785398163397")),
]  # fmt: skip

TUBE = 0.055
"""Radius of the arm's tubes [m]."""
GAP = 0.0025
"""Half the width of the dark groove between two links [m]."""
ALONG_MINUS_Y = Y_AXIS.T
"""Turns a shape that runs along z into one along -y."""


def elbow(keys: list[tuple[float, float, float, float]], colour: Colour = WHITE) -> Piece:
    """A bent tube from one joint to the next."""
    return limb(keys, colour, rows=16)


def barrel(length: float, radius: float, cap: float, colour: Colour = WHITE) -> list[Piece]:
    """A joint's housing along z, from its groove at z = 0 to its cap at z = length."""
    shell = [(0.0, GAP), (radius, GAP), (radius, length), (0.0, length)]
    lid = [(cap - 0.006, length - 0.002), (cap - 0.006, length + 0.002), (0.0, length + 0.002)]
    return [lathe(shell, colour, 30, 0.006), lathe(lid, LIGHT)]


def seam(z: float, radius: float = TUBE - 0.0015, depth: float = 0.006) -> Piece:
    """The dark ring that shows in the groove at the end of a tube along z."""
    return band(radius, z - depth, z + depth, DARK)


def base() -> list[Piece]:
    """Link 0: the foot with the connector panel behind, and the ring under the first joint."""
    foot = Loft(
        [
            (0.0, 0.0, 0.0, 0.0, 0.0, 2.4),
            (0.0, 0.0, 0.070, 0.150, 0.094, 2.4),
            (0.012, 0.0, 0.072, 0.152, 0.095, 2.4),
            (0.045, 0.0, 0.066, 0.145, 0.092, 2.3),
            (0.085, 0.0, 0.060, 0.110, 0.076, 2.2),
            (0.115, 0.0, 0.058, 0.072, 0.062, 2.0),
            (0.138, 0.0, 0.0565, 0.0565, 0.0565, 2.0),
            (0.138, 0.0, 0.0, 0.0, 0.0, 2.0),
        ]
    )
    ring = band(0.0574, 0.131, 0.136, LED, 36)
    panel = slab(0.085, 0.030, rim(0.0, 0.024, 0.004), 0.006, DARK, 4)
    upright = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    return [body(foot, WHITE, (26, 44)), ring, panel.moved(upright, (-0.134, 0.0, 0.028)), seam(0.139)]


def shoulder() -> list[Piece]:
    """Link 1: up from the base, and into the housing of joint 2 on the right."""
    keys = [(0, 0, -0.190, TUBE), (0, 0, -0.150, TUBE), (0, -0.005, -0.085, TUBE), (0, -0.045, -0.03, TUBE),
            (0, -0.060, 0, TUBE), (0, -0.108, 0, TUBE)]  # fmt: skip
    return [elbow(keys), *(piece.moved(ALONG_MINUS_Y) for piece in barrel(0.129, TUBE, 0.046)), seam(0.0).moved(Y_AXIS)]


def upper_arm() -> list[Piece]:
    """Link 2: the other half of joint 2, and up to joint 3."""
    keys = [(0, -0.192, 0, TUBE), (0, -0.150, 0, TUBE), (0, -0.085, 0.005, TUBE), (0, -0.03, 0.045, TUBE),
            (0, 0, 0.060, TUBE), (0, 0, 0.108, TUBE)]  # fmt: skip
    return [elbow(keys), *barrel(0.129, TUBE, 0.046), seam(-0.194).moved(Y_AXIS)]


def elbow_below() -> list[Piece]:
    """Link 3: from joint 3 to the elbow, which stands before the arm."""
    keys = [(0, 0, -0.119, TUBE), (0, 0, -0.085, TUBE), (0.012, 0.0, -0.045, TUBE), (0.060, 0.015, -0.012, TUBE),
            (0.0825, 0.045, 0, TUBE), (0.0825, 0.092, 0, TUBE)]  # fmt: skip
    half = [piece.moved(Y_AXIS, (0.0825, 0, 0)) for piece in barrel(0.111, TUBE, 0.046)]
    return [elbow(keys), *half, seam(0.0).moved(Y_AXIS, (0.0825, 0, 0))]


def elbow_above() -> list[Piece]:
    """Link 4: the other half of the elbow, and back to the arm's axis."""
    keys = [(-0.0825, 0.122, 0, TUBE), (-0.0825, 0.085, 0, TUBE), (-0.0705, 0.045, 0, TUBE), (-0.0225, 0.012, 0.015,
            TUBE),
            (0, 0, 0.045, TUBE), (0, 0, 0.092, TUBE)]  # fmt: skip
    return [elbow(keys), *barrel(0.111, TUBE, 0.046), seam(0.124).moved(Y_AXIS, (-0.0825, 0, 0))]


def forearm() -> list[Piece]:
    """Link 5: the long forearm, bulging towards the housing of joint 6."""
    keys = [(0, 0, -0.257, TUBE), (0, 0, -0.215, TUBE), (0, 0.008, -0.150, 0.053), (0, 0.030, -0.090, 0.050),
            (0, 0.062, -0.030, 0.049), (0, 0.075, -0.004, 0.049), (0, 0.112, 0, 0.049)]  # fmt: skip
    strut = limb(
        [(0, -0.012, -0.24, 0.042), (0, -0.012, -0.19, 0.042), (0, 0.004, -0.11, 0.040), (0, 0.03, -0.03, 0.045)], WHITE
    )
    half = [piece.moved(Y_AXIS) for piece in barrel(0.130, 0.0505, 0.042)]
    return [elbow(keys), strut, *half, seam(0.0, 0.049).moved(Y_AXIS)]


def wrist() -> list[Piece]:
    """Link 6: the other half of joint 6, and out to joint 7."""
    across = limb(
        [(-0.004, 0, 0.026, 0.044), (0.03, 0.004, 0.024, 0.043), (0.06, 0.010, 0.006, 0.042), (0.088, 0.016, 0, 0.042)],
        WHITE,
    )
    shell = [(0.0, -0.079), (0.036, -0.079), (0.042, -0.075), (0.0445, -0.065), (0.0445, 0.045), (0.042, 0.048),
             (0.0, 0.048)]  # fmt: skip
    housing = lathe(shell, WHITE, 30).moved(ALONG_MINUS_Y, (0.088, 0, 0))
    lid = lathe([(0.0, -0.081), (0.030, -0.081), (0.033, -0.0785), (0.0, -0.0785)], LIGHT, 26)
    return [across, *barrel(0.056, 0.0480, 0.038), housing, lid.moved(ALONG_MINUS_Y, (0.088, 0, 0)),
            seam(0.050, 0.0425, 0.004).moved(ALONG_MINUS_Y, (0.088, 0, 0))]  # fmt: skip


def flange() -> list[Piece]:
    """Link 7: the flange, with the buttons on its side."""
    disc = lathe(
        [(0.0, 0.053), (0.041, 0.053), (0.0435, 0.056), (0.0435, 0.090), (0.041, 0.094), (0.0, 0.094)], WHITE, 32
    )
    plate = lathe([(0.0, 0.090), (0.0315, 0.090), (0.0315, 0.106), (0.0, 0.106)], GREY, 28)
    pilot = limb([(0.020, 0.020, 0.0755, 0.022), (0.036, 0.036, 0.0765, 0.021), (0.051, 0.051, 0.079, 0.019),
                  (0.061, 0.061, 0.081, 0.017)], WHITE, 8, 20)  # fmt: skip
    button = limb(
        [(0.058, 0.058, 0.081, 0.010), (0.060, 0.060, 0.081, 0.010), (0.063, 0.063, 0.0815, 0.010)], LED, 3, 16, 0.002
    )
    return [disc, plate, pilot, button]


def hand() -> list[Piece]:
    """The hand: a wide flat box, with a dark rail at the end in which the fingers slide."""
    box = slab(0.203, 0.062, rim(-0.002, 0.057, 0.012), 0.028, WHITE, 6)
    rail = slab(0.190, 0.044, rim(0.045, 0.066, 0.003), 0.020, BLACK, 6)
    neck = lathe([(0.0, -0.003), (0.0315, -0.003), (0.0315, 0.010), (0.0, 0.010)], GREY, 26)
    return [box, rail, neck]


def finger(side: float) -> list[Piece]:
    """One finger: side 1 is the left one, which opens towards +y."""
    foot = [(0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0095, 0.0095, 0.0115), (0.015, 0.0, 0.0095, 0.0095, 0.0115),
            (0.022, 0.0, 0.009, 0.009, 0.0105), (0.037, 0.0, 0.009, 0.009, 0.0090)]  # fmt: skip
    tip = [(0.034, 0.0, 0.009, 0.009, 0.0090), (0.046, 0.0, 0.009, 0.009, 0.0080), (0.0538, 0.0, 0.008, 0.008, 0.0070),
           (0.0538, 0.0, 0.0, 0.0, 0.0)]  # fmt: skip
    shapes = [(foot, GREY, (14, 28)), (tip, BLACK, (8, 28))]
    return [
        body(Loft([(*key, 3.5) for key in keys]), colour, size).moved(shift=(0.0, side * 0.0118, 0.0))
        for keys, colour, size in shapes
    ]


def links() -> dict[str, list[Piece]]:
    """The pieces of every drawn link, in its own frame."""
    arm = (base, shoulder, upper_arm, elbow_below, elbow_above, forearm, wrist, flange)
    drawn = {link(number): shape() for number, shape in enumerate(arm)}
    return drawn | {"panda_hand": hand(), "panda_leftfinger": finger(1.0), "panda_rightfinger": finger(-1.0)}
