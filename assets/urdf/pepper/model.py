"""Pepper: its joints, and which shapes are drawn with which link."""

from __future__ import annotations

from modelling.description import ZERO, Inertial, Joint, X, Y, Z
from modelling.surfaces import Piece
from pepper import arms, parts

ROOT = "base_link"
SHARED: dict[str, str] = {}
STRONG, WEAK = ("5.428", "7.33998"), ("2.666", "9.22756")  # effort, velocity of the two kinds of arm motors
LEAN = ("-0.514872", "0.514872")  # limits of hip roll and knee


def arm(side: str) -> list[Joint]:
    """The joints of one arm; left and right differ by the sign of y and swapped limits of the roll joints."""
    left = side == "L"
    sign = "" if left else "-"
    wrist, gripper = (f"{side.lower()}_{name}" for name in ("wrist", "gripper"))
    near, far = ("0.00872665", "1.56207")
    rolls = {True: (near, far), False: ("-" + far, "-" + near)}
    tilted = ("0", "-0.157079", "0")
    return [
        Joint(f"{side}ShoulderPitch", "torso", f"{side}Shoulder", ("-0.057", f"{sign}0.14974", "0.08682"), ZERO, Y,
              ("-2.08567", "2.08567", *STRONG)),
        Joint(f"{side}ShoulderRoll", f"{side}Shoulder", f"{side}Bicep", ZERO, ZERO, Z, (*rolls[left], *WEAK)),
        Joint(f"{side}ElbowYaw", f"{side}Bicep", f"{side}Elbow", ("0.1812", f"{sign}0.015", "0.00013"), tilted, X,
              ("-2.08567", "2.08567", *STRONG)),
        Joint(f"{side}ElbowRoll", f"{side}Elbow", f"{side}ForeArm", ZERO, ZERO, Z, (*rolls[not left], *WEAK)),
        Joint(f"{side}WristYaw", f"{side}ForeArm", wrist, ("0.15", "0", "0"), ZERO, X,
              ("-1.82387", "1.82387", "0.2014", "17.3835")),
        Joint(f"{side}Hand", wrist, gripper, ("0.025", "0", "0"), ZERO, X, ("0.02", "0.98", "0.144", "12.56")),
    ]  # fmt: skip


JOINTS = [
    Joint("base_link_fixedjoint", "base_link", "torso", ZERO),
    Joint("HeadYaw", "torso", "Neck", ("-0.038", "0", "0.1699"), ZERO, Z, ("-2.08567", "2.08567", *STRONG)),
    Joint("HeadPitch", "Neck", "Head", ZERO, ZERO, Y, ("-0.706858", "0.637045", *WEAK)),
    Joint("HipRoll", "torso", "Hip", ("2e-05", "0", "-0.139"), ZERO, X, (*LEAN, "10.1884", "2.27032")),
    Joint("HipPitch", "Hip", "Pelvis", ("0", "0", "-0.079"), ZERO, Y, ("-1.03847", "1.03847", "19.787", "2.93276")),
    Joint("KneePitch", "Pelvis", "Tibia", ("0", "0", "-0.268"), ZERO, Y, (*LEAN, "27.702", "2.93276")),
    Joint("base_footprint_joint", "Tibia", "base_footprint", ("0", "0", "-0.334")),
    *arm("L"),
    *arm("R"),
    Joint("Tablet_sensor_fixedjoint", "torso", "Tablet_frame", ("0.0839249", "0", "0.06251"), ("0", "-0.523599", "0")),
    Joint("CameraTop_sensor_fixedjoint", "Head", "CameraTop_frame", ("0.08601", "0", "0.16284")),
    Joint("CameraBottom_sensor_fixedjoint", "Head", "CameraBottom_frame", ("0.09262", "0", "0.06177"),
          ("0", "0.698132", "0")),
]  # fmt: skip
ARM_INERTIALS = {
    "Shoulder": Inertial(0.3125, (0.00018, -0.01856, 0.00099), (0.08, 0.09, 0.075)),
    "Bicep": Inertial(0.50527, (0.08151, 0.01284, -0.01017), (0.19, 0.08, 0.09)),
    "Elbow": Inertial(0.27495, (-0.02297, -0.00019, 0.00119), (0.1, 0.065, 0.065)),
    "ForeArm": Inertial(0.16579, (0.0593, 0.00271, -0.01014), (0.12, 0.07, 0.07)),
    "wrist": Inertial(0.27555, (0.03536, -0.00072, -0.00207), (0.17, 0.08, 0.06)),
}
"""Of the left arm: mass and centre as its maker publishes them, size of the solid by our shapes (README.md)."""


def inertials() -> dict[str, Inertial]:
    """Of both arms' links; the right arm is the left one's mirror image."""
    found = {}
    for side, sign in (("L", 1.0), ("R", -1.0)):
        for part, left in ARM_INERTIALS.items():
            x, y, z = left.centre
            name = f"{side.lower()}_{part}" if part == "wrist" else side + part
            found[name] = Inertial(left.mass, (x, sign * y, z), left.size)
    return found


INERTIALS = inertials()
STANDING = {"torso": 0.82, "Hip": 0.681, "Pelvis": 0.602, "Tibia": 0.334}
"""Height above the floor of the links whose shapes are drawn in the standing frame."""


def links() -> dict[str, list[Piece]]:
    """The pieces of every drawn link, in its own frame."""
    body = {"torso": parts.torso(), "Hip": parts.hip(), "Pelvis": parts.pelvis(), "Tibia": parts.tibia()}
    drawn = {
        name: [piece.moved(shift=(0.0 if name == "torso" else -2e-5, 0.0, -STANDING[name])) for piece in pieces]
        for name, pieces in body.items()
    }
    drawn |= {"Neck": parts.neck(), "Head": parts.head()}
    arm_parts = {
        "Shoulder": arms.shoulder(), "Bicep": arms.biceps(), "Elbow": arms.elbow(), "ForeArm": arms.forearm(),
        "wrist": arms.hand(),
    }  # fmt: skip
    for part, pieces in arm_parts.items():
        for side in ("L", "R"):
            name = f"{side.lower()}_{part}" if part == "wrist" else side + part
            drawn[name] = pieces if side == "L" else [piece.mirrored() for piece in pieces]
    return drawn
