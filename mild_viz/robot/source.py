"""The same robot with its manufacturer's looks: a description that the package `robot_descriptions` downloads.

Only what is drawn is taken from there. Joints, limits and end effectors stay ours, which models and safety rely on:
versions of a description differ in limits, in the frame at the root, and in which frames there are at the hand.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import sys
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.robot.description import Description, read_description
from mild_viz.robot.spec import RobotSpec

logger = logging.getLogger(__name__)

RobotSource = Literal["own", "robot_descriptions"]
"""Where what is drawn comes from: our own files, or the package of that name."""

PACKAGE = "robot_descriptions"

TOLERANCE = 0.005
"""Farthest that a link may be from where it is in our description [m]."""

POSTURES = 20
"""Random postures in which links are compared."""


def published_description(spec: RobotSpec, ours: Description) -> Description:
    """The manufacturer's description of the robot, in the base frame of ours.

    Raises:
        UserError: saying why there is none: the package names none for this robot or is missing, it cannot be
            downloaded or read, or is of another robot: its arms lack joints of ours, or put a link elsewhere.
    """
    theirs = read_description(_download(spec))
    have = [joint.name for joint in theirs.joints]
    for arm in spec.arms.values():
        missing = [name for name in arm.joints if name not in have]
        if missing:
            raise UserError(f"{theirs.path} has no joint '{missing[0]}' of ours; it has: {', '.join(have)}")
    first = spec.main.joints[0]
    rest = dict(spec.rest)
    placed = theirs.placed(_frame(ours, first, rest) @ np.linalg.inv(_frame(theirs, first, rest)))
    _compare(spec, ours, placed)
    return placed


def _download(spec: RobotSpec) -> Path:
    """The URDF that the package names; the package fetches it at the first time, saying so where messages go."""
    if spec.robot_descriptions is None:
        raise UserError(f"{PACKAGE} has no {spec.title}: its robot.toml names no module of that package")
    os.environ.setdefault("GIT_TERMINAL_PROMPT", "0")  # a person is not asked for a password that does not help
    try:
        importlib.import_module(PACKAGE)  # first alone: is it the package that is missing, or the module?
        with contextlib.redirect_stdout(sys.stderr):
            module = importlib.import_module(f"{PACKAGE}.{spec.robot_descriptions}")
        return Path(module.URDF_PATH)
    except ModuleNotFoundError as error:
        if error.name == f"{PACKAGE}.{spec.robot_descriptions}":
            raise UserError(f"{PACKAGE} has no module {spec.robot_descriptions}") from None
        raise UserError(f"the package {error.name} is not installed; pip install 'mild-viz[robots]'") from None
    except Exception as error:  # git's, the file system's, or the package's own
        print(file=sys.stderr)  # the package's progress bar leaves its line open
        lines = [line.strip(" '") for line in str(error).splitlines() if line.strip(" '")] or [type(error).__name__]
        reason = next((line[line.index("fatal:") :] for line in lines if "fatal:" in line), lines[-1])
        raise UserError(f"{spec.robot_descriptions} cannot be downloaded, is there a network? ({reason})") from None


def _frame(description: Description, joint: str, angles: dict[str, float]) -> Float[np.ndarray, "4 4"]:
    """Pose of a joint's child in the base frame; joints without an angle are at 0."""
    return description.pose(description.joint(joint).child, angles)


def _compare(spec: RobotSpec, ours: Description, theirs: Description) -> None:
    """`UserError` where a joint of an arm is not where it is in our description."""
    rng = np.random.default_rng(0)
    for arm in spec.arms.values():
        limits = [(ours.joint(name).lower, ours.joint(name).upper) for name in arm.joints]
        lower, upper = np.clip(np.array(limits).T, -np.pi, np.pi)
        for row in rng.uniform(lower, upper, (POSTURES, len(arm.joints))):
            angles = {**spec.rest, **dict(zip(arm.joints, row.tolist(), strict=True))}
            for name in arm.joints:
                gap = np.linalg.norm((_frame(ours, name, angles) - _frame(theirs, name, angles))[:3, 3])
                if not gap <= TOLERANCE:
                    raise UserError(
                        f"{theirs.path}: joint '{name}' is {100 * gap:.1f} cm from where ours is; it is another robot"
                    )
