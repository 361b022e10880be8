"""ABB YuMi (IRB 14000) with its grippers: joints, and the shapes of the links, each in its link's frame."""

from __future__ import annotations

import numpy as np
from modelling.description import ZERO, Joint, Z
from modelling.palette import BLACK, DARK, GREY, LED, LIGHT, WHITE
from modelling.round import band, lathe, limb, tube
from modelling.surfaces import Y_AXIS, Array, Loft, Piece, body, rim, slab

ROOT = "yumi_base_link"

UP, DOWN = ("1.57079632679", "0", "0"), ("-1.57079632679", "0", "0")
SLOW, FAST = ("300", "3.14159265359"), ("300", "6.98131700798")  # effort, velocity of joints 1, 2, 7, 3 and 4, 5, 6
WIDE = ("-2.94087978961", "2.94087978961", *SLOW)
ARMS = {
    "r": (("0.05355", "-0.0725", "0.41492"), ("-0.9795", "-0.5682", "-2.3155")),
    "l": (("0.05355", "0.07250", "0.41492"), ("0.9781", "-0.5716", "2.3180")),
}
"""Where each arm stands on the body: origin and roll, pitch, yaw of its first joint."""
TIP = "0.128"
"""Height of the grasp point above the gripper's base, between the tips of the fingers [m]."""


def arm(side: str) -> list[Joint]:
    """The joints of one arm from the body to the wrist, in ABB's numbering, and of its gripper."""
    steps = [
        (1, *ARMS[side], WIDE),
        (2, ("0.03", "0", "0.1"), UP, ("-2.50454747661", "0.759218224618", *SLOW)),
        (7, ("-0.03", "0.17283", "0"), DOWN, WIDE),
        (3, ("-0.04188", "0", "0.07873"), ("1.57079632679", "-1.57079632679", "0"),
         ("-2.15548162621", "1.3962634016", *SLOW)),
        (4, ("0.0405", "0.16461", "0"), DOWN, ("-5.06145483078", "5.06145483078", *FAST)),
        (5, ("-0.027", "0", "0.10039"), UP, ("-1.53588974176", "2.40855436775", *FAST)),
        (6, ("0.027", "0.029", "0"), DOWN, ("-3.99680398707", "3.99680398707", *FAST)),
    ]  # fmt: skip
    names = ["yumi_body", *(f"yumi_link_{number}_{side}" for number in range(1, 8))]
    base, turned = f"gripper_{side}_base", ("0", "0", "3.14159265359")
    finger, follower = f"gripper_{side}_joint", f"gripper_{side}_joint_m"
    slide = {"axis": ("-1", "0", "0"), "limits": ("0", "0.025", "20", "2"), "slides": True}
    return [
        *(
            Joint(f"yumi_joint_{number}_{side}", parent, child, xyz, rpy, Z, limits)
            for (number, xyz, rpy, limits), parent, child in zip(steps, names[:-1], names[1:], strict=True)
        ),
        Joint(f"yumi_link_7_{side}_joint", names[-1], base, ("0", "0", "0.007"), turned),
        Joint(finger, base, f"gripper_{side}_finger_r", ("0", "-0.0065", "0.0837"), **slide),
        Joint(follower, base, f"gripper_{side}_finger_l", ("0", "0.0065", "0.0837"), turned, **slide, mimic=finger),
        Joint(f"gripper_{side}_tip_joint", base, f"gripper_{side}_tip", ("0", "0", TIP)),
    ]


JOINTS = [Joint("yumi_base_link_to_body", "yumi_base_link", "yumi_body", ZERO), *arm("r"), *arm("l")]
SHARED = {joint.child: joint.child.replace("_l", "_r", 1) if joint.child.startswith("gripper") else
          f"{joint.child[:-2]}_r" for joint in arm("l") if not joint.child.endswith("tip")}  # fmt: skip
SHARED |= {f"gripper_{side}_finger_l": "gripper_r_finger_r" for side in "rl"}
"""Both arms have the same meshes, and both fingers too."""


def turned_to(direction: str) -> Array:
    """Turns a shape that runs along z into one along the direction."""
    return {"z": np.eye(3), "y": Y_AXIS, "-y": Y_AXIS.T}[direction]


def drum(low: float, high: float, radius: float) -> list[Piece]:
    """A joint's housing along z with a soft dome at the far end and a dark joint at the near one."""
    near, far = (low, high) if abs(low) < abs(high) else (high, low)
    way, depth = (1.0 if far > near else -1.0), abs(far - near)
    profile = [(0.0, near + way * 0.005), (radius, near + way * 0.005), (radius, near + way * 0.80 * depth),
               (0.72 * radius, far), (0.0, far)]  # fmt: skip
    inner = near + way * 0.008
    return [
        lathe(profile[:: int(way)], WHITE, 30, 0.012),
        band(0.93 * radius, min(near, inner), max(near, inner), DARK),
    ]


def trunk() -> list[Piece]:
    """The body: a foot, a column at the back and the overhanging shoulders, and the plates that carry the arms."""
    foot = Loft(
        [
            (-0.100, -0.17, 0.0, 0.0, 0.0, 3.5),
            (-0.100, -0.17, 0.255, 0.180, 0.190, 3.5),
            (-0.085, -0.17, 0.268, 0.187, 0.199, 3.5),
            (-0.030, -0.17, 0.268, 0.188, 0.199, 3.5),
            (-0.005, -0.17, 0.262, 0.188, 0.198, 3.2),
            (0.010, -0.17, 0.190, 0.187, 0.190, 3.0),
            (0.035, -0.18, 0.110, 0.178, 0.160, 2.8),
            (0.080, -0.21, 0.085, 0.148, 0.122, 2.8),
            (0.130, -0.22, 0.080, 0.135, 0.108, 2.8),
            (0.130, -0.22, 0.0, 0.0, 0.0, 2.8),
        ]
    )
    path = np.array(
        [(-0.235, 0.09, 0.112), (-0.240, 0.16, 0.112), (-0.240, 0.23, 0.112), (-0.236, 0.29, 0.116),
         (-0.205, 0.345, 0.122), (-0.140, 0.378, 0.118), (-0.060, 0.388, 0.108), (0.000, 0.390, 0.098)]
    )  # fmt: skip
    spine = limb([(x, 0.0, z, radius) for x, z, radius in path], WHITE, 22, 40, 0.03)
    chest = lathe([(0.0, 0.0), (0.074, 0.0), (0.070, 0.011), (0.0, 0.012)], GREY, 36)
    forward = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    light = lathe([(0.0, 0.0), (0.012, 0.0), (0.012, 0.006), (0.0, 0.008)], LED, 18)
    stretched = Piece(spine.vertices * (1.0, 1.08, 1.0), spine.faces, spine.colour)
    return [body(foot, WHITE, (30, 52)), stretched, chest.moved(forward, (0.004, 0.0, 0.392)), *mounts(),
            light.moved(shift=(-0.02, 0.0, 0.487))]  # fmt: skip


def mounts() -> list[Piece]:
    """The rings on the body from which the arms start."""
    pieces = []
    for origin, angles in ARMS.values():
        roll, pitch, yaw = (float(value) for value in angles)
        turn = about_z(yaw) @ about_y(pitch) @ about_x(roll)
        ring = [
            (0.0, -0.075),
            (0.052, -0.075),
            (0.062, -0.050),
            (0.066, -0.020),
            (0.066, -0.006),
            (0.062, -0.002),
            (0.0, -0.002),
        ]
        pieces.append(lathe(ring, LIGHT, 34).moved(turn, [float(value) for value in origin]))
    return pieces


def about_x(angle: float) -> Array:
    return np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])


def about_y(angle: float) -> Array:
    return np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


def about_z(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])


def collar(radius: float) -> Piece:
    """The dark ring at the root of a link, about z."""
    return band(radius, -0.002, 0.006, DARK)


def first() -> list[Piece]:
    """Link 1: from the body into the housing of joint 2."""
    keys = [(0, 0, 0.003, 0.060), (0, 0, 0.022, 0.057), (0.006, -0.008, 0.050, 0.050), (0.020, -0.026, 0.080, 0.048),
            (0.030, -0.036, 0.100, 0.047), (0.030, -0.052, 0.100, 0.046)]  # fmt: skip
    housing = [piece.moved(turned_to("-y"), (0.03, 0.0, 0.1)) for piece in drum(0.008, 0.078, 0.049)]
    return [limb(keys, WHITE), *housing, collar(0.056)]


def second() -> list[Piece]:
    """Link 2: the upper arm, from joint 2 to joint 7."""
    keys = [(0, 0, -0.050, 0.044), (0, 0.005, -0.036, 0.046), (-0.012, 0.045, -0.024, 0.047), (-0.028, 0.090, -0.002,
            0.047),
            (-0.030, 0.130, 0, 0.051), (-0.030, 0.169, 0, 0.052)]  # fmt: skip
    return [limb(keys, LIGHT), *drum(-0.078, 0.0, 0.048), joint_core(0.042)]


def third() -> list[Piece]:
    """Link 3: from joint 7 into the housing of joint 3."""
    keys = [(0, 0, 0.003, 0.046), (0, 0, 0.020, 0.046), (-0.010, -0.010, 0.040, 0.045), (-0.030, -0.028, 0.064, 0.045),
            (-0.0419, -0.038, 0.0787, 0.045), (-0.0419, -0.052, 0.0787, 0.044)]  # fmt: skip
    housing = [piece.moved(turned_to("-y"), (-0.04188, 0.0, 0.07873)) for piece in drum(0.009, 0.079, 0.048)]
    return [limb(keys, WHITE), *housing, collar(0.043)]


def fourth() -> list[Piece]:
    """Link 4: the lower arm, from joint 3 to joint 4."""
    keys = [(0, 0, -0.050, 0.042), (0.002, 0.005, -0.036, 0.043), (0.018, 0.045, -0.022, 0.042), (0.038, 0.090, 0,
            0.042),
            (0.0405, 0.125, 0, 0.044), (0.0405, 0.161, 0, 0.042)]  # fmt: skip
    return [limb(keys, LIGHT), *drum(-0.078, 0.0, 0.047), joint_core(0.041)]


def fifth() -> list[Piece]:
    """Link 5: from joint 4 into the housing of joint 5."""
    keys = [(0, 0, 0.003, 0.040), (0, -0.004, 0.022, 0.036), (-0.008, -0.024, 0.050, 0.032), (-0.020, -0.040, 0.080,
            0.031),
            (-0.027, -0.046, 0.100, 0.031)]  # fmt: skip
    housing = [piece.moved(turned_to("-y"), (-0.027, 0.0, 0.10039)) for piece in drum(0.027, 0.070, 0.033)]
    return [limb(keys, WHITE), *housing, collar(0.037)]


def sixth() -> list[Piece]:
    """Link 6: the wrist, from joint 5 to joint 6."""
    keys = [(0, 0, -0.032, 0.030), (0.004, -0.012, -0.022, 0.031), (0.020, -0.022, -0.006, 0.032), (0.027, -0.012, 0,
            0.032),
            (0.027, 0.020, 0, 0.032)]  # fmt: skip
    return [limb(keys, WHITE), *drum(-0.066, -0.026, 0.032), *drum(0.0, 0.027, 0.031), joint_core(0.028, 0.026)]


def joint_core(radius: float, half: float = 0.010) -> Piece:
    """The dark shaft that shows between the two housings of a joint along z."""
    return band(radius, -half, half, DARK)


def seventh() -> list[Piece]:
    """Link 7: the flange."""
    return [
        lathe(
            [(0.0, -0.009), (0.027, -0.009), (0.030, -0.006), (0.030, 0.005), (0.028, 0.0075), (0.0, 0.0075)], DARK, 28
        )
    ]


def gripper() -> list[Piece]:
    """The gripper's base: a rounded white housing with the slot of the fingers at its end."""
    shell = Loft(
        [
            (0.0, 0.0, 0.0, 0.0, 0.0, 3.0),
            (0.0, 0.0, 0.033, 0.033, 0.033, 2.2),
            (0.010, 0.0, 0.038, 0.038, 0.0345, 2.6),
            (0.035, 0.0, 0.041, 0.041, 0.0345, 3.0),
            (0.060, 0.0, 0.040, 0.040, 0.031, 3.0),
            (0.080, 0.0, 0.036, 0.036, 0.021, 3.0),
            (0.0825, 0.0, 0.034, 0.034, 0.019, 3.0),
            (0.0825, 0.0, 0.0, 0.0, 0.0, 3.0),
        ]
    )
    slot = slab(0.030, 0.058, rim(0.074, 0.088, 0.002), 0.010, BLACK, 4)
    lens = lathe([(0.0, 0.0), (0.009, 0.0), (0.009, 0.003), (0.0, 0.004)], BLACK, 20)
    return [body(shell, WHITE, (22, 36)), slot, lens.moved(turned_to("y"), (0.0, 0.033, 0.042))]


def finger() -> list[Piece]:
    """One finger, which closes at x = 0."""
    foot = slab(0.020, 0.009, rim(0.0, 0.018, 0.002), 0.003, GREY, 3)
    tip = tube(np.array([(-0.0058, 0.0065, 0.012), (-0.0055, 0.0065, 0.030), (-0.0047, 0.0065, 0.049)]),
               np.array([0.0056, 0.0052, 0.0042]), GREY, 14, 0.001)  # fmt: skip
    return [foot.moved(shift=(-0.0055, 0.006, 0.0)), tip]


def links() -> dict[str, list[Piece]]:
    """The pieces of body, right arm and gripper, each link in its own frame."""
    arm_shapes = (first, second, third, fourth, fifth, sixth, seventh)
    drawn = {f"yumi_link_{number}_r": shape() for number, shape in enumerate(arm_shapes, start=1)}
    return {"yumi_body": trunk()} | drawn | {"gripper_r_base": gripper(), "gripper_r_finger_r": finger()}
