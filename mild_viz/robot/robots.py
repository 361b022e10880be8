"""The robots that are known by name; any other description is given by the path of its URDF."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mild_viz.errors import UserError
from mild_viz.paths import assets

PEPPER_JOINTS = ("RShoulderPitch", "RShoulderRoll", "RElbowYaw", "RElbowRoll")
"""Joints of Pepper's right arm that the model controls, in the column order of the retargeting."""

PEPPER_REST = {
    "RShoulderPitch": 1.5,
    "RShoulderRoll": -0.12,
    "RElbowYaw": 1.2,
    "RElbowRoll": 0.5,
    "RWristYaw": 0.8,
    "RHand": 0.5,
    "LShoulderPitch": 1.5,
    "LShoulderRoll": 0.12,
    "LElbowYaw": -1.2,
    "LElbowRoll": -0.5,
    "LWristYaw": -0.8,
    "LHand": 0.5,
}
"""Standing with both arms hanging, palms inward, hands half closed [rad]; joints not named here are at 0."""

PEPPER_HANDS = {
    "wave": {"RWristYaw": 0.0, "RHand": 0.98},
    "handshake": {"RWristYaw": 1.2, "RHand": 0.75},
    "rocket": {"RWristYaw": 0.8, "RHand": 0.02},
    "parachute": {"RWristYaw": 1.2, "RHand": 0.02},
    "handover": {"RWristYaw": 1.2, "RHand": 0.75},
}
"""The fixed hand of each interaction (Sec. IK adaptation: "a fixed value for the wrist for each interaction").

The values are ours: the palm looks forward in a wave, the thumb up in a handshake, the hand is a fist in a bump.
Pepper's end effector lies on the wrist's axis, so that none of them moves it.
"""


@dataclass(frozen=True)
class KnownRobot:
    """What `--robot NAME` stands for."""

    urdf: str
    """Below `assets/urdf`."""
    joint_names: tuple[str, ...]
    end_effector: str
    rest: dict[str, float] = field(default_factory=dict)
    hands: dict[str, dict[str, float]] = field(default_factory=dict)
    """Per action, where joints beyond the controlled ones stand [rad]; they must not move the end effector."""


ROBOTS: dict[str, KnownRobot] = {
    "pepper": KnownRobot("pepper/pepper.urdf", PEPPER_JOINTS, "r_gripper", PEPPER_REST, PEPPER_HANDS),
}


def find_urdf(name_or_path: str) -> tuple[str, Path]:
    """Name and description file of a robot, given by a name in `ROBOTS` or by the path of a .urdf file.

    Raises `UserError` where it is neither, or the file does not exist.
    """
    known = ROBOTS.get(name_or_path)
    path = assets() / "urdf" / known.urdf if known else Path(name_or_path).expanduser()
    if known is None and path.suffix.lower() != ".urdf":
        raise UserError(f"robot '{name_or_path}' is unknown; valid: {', '.join(ROBOTS)}, or the path of a .urdf file")
    if not path.is_file():
        raise UserError(f"robot '{name_or_path}': {path} is not a file; expected a URDF description")
    return (name_or_path if known else path.stem), path
