"""The robots that are known by name; any other description is given by the path of its URDF."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mild_viz.errors import UserError
from mild_viz.paths import assets


def robot_title(name: str) -> str:
    """A robot's name as its maker writes it; one that is not known by name is only capitalised."""
    return {"yumi": "YuMi"}.get(name, f"{name[:1].upper()}{name[1:]}")


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


PANDA_JOINTS = tuple(f"panda_joint{number}" for number in range(1, 8))
"""The arm of the Panda from its base to its flange."""

PANDA_FINGERS: tuple[str, ...] = ("panda_finger_joint1", "panda_finger_joint2")
PANDA_REST = {
    "panda_joint2": -0.785398,
    "panda_joint4": -2.356194,
    "panda_joint6": 2.6,
    "panda_joint7": 0.785398,
    "panda_finger_joint1": 0.02,
    "panda_finger_joint2": 0.02,
}
"""The maker's ready pose [rad], but the hand raised until it points forward, 30 degrees below the horizontal; the
fingers stand as if they held something [m]."""

PANDA_HANDS: dict[str, dict[str, float]] = {
    action: dict.fromkeys(PANDA_FINGERS, opening)
    for action, opening in (("wave", 0.04), ("handshake", 0.04), ("rocket", 0.0), ("parachute", 0.0))
}
"""The fingers: open in a wave, closed in a bump, at rest (holding the object) in a handover [m]."""

YUMI_NUMBERS = (1, 2, 7, 3, 4, 5, 6)
"""ABB's numbers of an arm's joints from the body to the wrist: also the column order of the recordings."""

YUMI_JOINTS = tuple(f"yumi_joint_{number}_r" for number in YUMI_NUMBERS)
YUMI_READY = (0.9, -1.47, -2.19, 0.06, 1.36, 0.18, 1.43)
YUMI_REST = {
    f"yumi_joint_{number}_{side}": angle * (sign if number in (1, 7, 4, 6) else 1.0)
    for side, sign in (("r", 1.0), ("l", -1.0))
    for number, angle in zip(YUMI_NUMBERS, YUMI_READY, strict=True)
} | {"gripper_r_joint": 0.005, "gripper_l_joint": 0.005}
"""Both arms as the right one stands at the start of the HRI-Yumi recordings (median), the left its mirror image."""


@dataclass(frozen=True)
class KnownRobot:
    """What `--robot NAME` stands for."""

    urdf: str
    """Below `assets/urdf`."""
    joint_names: tuple[str, ...]
    end_effector: str
    rest: dict[str, float] = field(default_factory=dict)
    hands: dict[str, dict[str, float]] = field(default_factory=dict)
    """Per action, where joints beyond the controlled ones stand [rad or m]; they must not move the end effector."""


ROBOTS: dict[str, KnownRobot] = {
    "pepper": KnownRobot("pepper/pepper.urdf", PEPPER_JOINTS, "r_gripper", PEPPER_REST, PEPPER_HANDS),
    "panda": KnownRobot("panda/panda.urdf", PANDA_JOINTS, "end_effector_frame", PANDA_REST, PANDA_HANDS),
    "yumi": KnownRobot("yumi/yumi.urdf", YUMI_JOINTS, "gripper_r_tip", YUMI_REST),
}

DATASET_ROBOTS = {"demo": "pepper", "nuisi": "pepper", "buetepage": "pepper", "yumi": "yumi", "handover": "panda"}
"""The robot that a dataset's models are trained for: the recorded one, else the one that the partner's arm suits."""


def robot_of(dataset: str) -> str:
    """Name in `ROBOTS` of the robot that models of a dataset are trained for. `UserError` for an unknown dataset."""
    if dataset not in DATASET_ROBOTS:
        raise UserError(f"no robot is known for dataset '{dataset}'; valid: {', '.join(DATASET_ROBOTS)}")
    return DATASET_ROBOTS[dataset]


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
