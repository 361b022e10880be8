"""The controlled arm: its fixed offsets folded from pytorch-kinematics' parse, cached on disk."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import tempfile
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.robot.description import TURNING, Description, Joint
from mild_viz.robot.position_rule import PositionRule
from mild_viz.trial import freeze_arrays

FOLD_VERSION = 2
"""Raise it whenever the fold changes, so that older caches are not used."""


REACH_STARTS = 256
"""Random postures from which the longest reach is sought; twice as many find less than a millimetre more."""

JOINTED = (*TURNING, "prismatic", "fixed")
"""Joint types that may lie between the base and the end effector."""


@dataclass(frozen=True, eq=False)
class ArmChain:
    """J turning joints between the base and the end effector, everything fixed in between folded.

    The end effector's pose is offsets[0] R(axes[0], q[0]) offsets[1] ... R(axes[J-1], q[J-1]) offsets[J].
    """

    joint_names: tuple[str, ...]
    end_effector: str
    lower: Float[np.ndarray, " J"]
    upper: Float[np.ndarray, " J"]
    velocity: Float[np.ndarray, " J"]
    """Largest speed of each joint [rad/s]; infinite where the description states none."""
    rest: Float[np.ndarray, " J"]
    """Where the joints stand when nothing moves them [rad]."""
    offsets: Float[np.ndarray, "_ 4 4"]
    axes: Float[np.ndarray, "J 3"]
    elbow: str | None = None
    """Joint whose origin is the elbow."""
    position: PositionRule = PositionRule()
    """How it takes over a person's posture."""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def n_joints(self) -> int:
        return len(self.joint_names)

    @cached_property
    def arm(self) -> Float[np.ndarray, "_ 12"]:
        """The arm as `kinematics.kernels` takes it. Writable, because numba types read-only arrays apart."""
        arm = np.zeros((self.n_joints + 1, 12))
        arm[:, :4] = quaternions(self.offsets[:, :3, :3])
        arm[:, 4:7] = self.offsets[:, :3, 3]
        arm[:-1, 7:10], arm[:-1, 10], arm[:-1, 11] = self.axes, self.lower, self.upper
        return arm

    @cached_property
    def shoulder(self) -> Float[np.ndarray, "3"]:
        """Where the first joint is, in the base frame [m]."""
        return self.offsets[0, :3, 3]

    @cached_property
    def reach(self) -> float:
        """Longest distance from the first joint to the end effector inside the limits [m].

        The links bound it; where bends or limits keep an arm from that, it is the largest distance that IK towards
        far points in many directions finds.
        """
        from mild_viz.robot.ik import forward, solve_ik  # they take a chain

        rng = np.random.default_rng(0)
        away = rng.normal(size=(REACH_STARTS, 3))
        away *= 10.0 / np.linalg.norm(away, axis=1, keepdims=True)
        starts = rng.uniform(
            np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi), (REACH_STARTS, self.n_joints)
        )
        stretched = solve_ik(self, self.shoulder + away, starts, 1.0, 0.0)
        distances = np.linalg.norm(forward(self, stretched) - self.shoulder, axis=1)
        return float(distances.max())


def quaternions(rotations: Float[np.ndarray, "N 3 3"]) -> Float[np.ndarray, "N 4"]:
    """Unit quaternions (wxyz, w >= 0) of N rotation matrices."""
    from scipy.spatial.transform import Rotation

    return np.ascontiguousarray(Rotation.from_matrix(rotations).as_quat(canonical=True)[:, [3, 0, 1, 2]])


def kernel_array(values: np.ndarray) -> np.ndarray:
    """The array as float64, contiguous and writable, so that every call meets the same compiled kernel."""
    return np.require(values, dtype=np.float64, requirements=["C", "W"])


def load_chain(
    description: Description,
    joint_names: tuple[str, ...],
    end_effector: str,
    rest: dict[str, float],
    tip_offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> ArmChain:
    """The chain of `joint_names` up to `end_effector`, moved by `tip_offset` [m] in its own frame.

    Joints in between that are not named rest.

    Raises `UserError` where a joint or the end effector is missing, where a joint does not turn or states no
    limits, where it is not between the base and the end effector in the given order, or where a joint of several
    degrees of freedom is.
    """
    joints = [description.joint(name) for name in joint_names]
    description.require_link(end_effector)
    for joint in joints:
        if joint.kind not in TURNING or joint.mimic is not None:
            kind = "mimic" if joint.mimic is not None else joint.kind
            raise UserError(f"{description.path}: joint '{joint.name}' is {kind}; a controlled joint must turn freely")
        if joint.kind == "revolute" and not np.isfinite([joint.lower, joint.upper]).all():
            raise UserError(
                f"{description.path}: joint '{joint.name}' is revolute and has the limits {joint.lower} to "
                f"{joint.upper}; expected a <limit> with a finite lower and upper [rad], or the type continuous"
            )
    between = [joint.name for joint in description.path_to(end_effector)]
    for joint in description.path_to(end_effector):
        if joint.kind in ("floating", "planar"):
            raise UserError(
                f"{description.path}: joint '{joint.name}', between the base and '{end_effector}', is {joint.kind}; "
                f"valid there: {', '.join(JOINTED)}"
            )
    if [name for name in between if name in joint_names] != list(joint_names):
        raise UserError(
            f"{description.path}: joints {', '.join(joint_names)} are not in this order between the base and "
            f"'{end_effector}'; there are: {', '.join(between)}"
        )
    values = description.values(rest)
    offsets, axes = _cached_fold(description, joint_names, end_effector, values)
    tip = np.eye(4)
    tip[:3, 3] = tip_offset
    offsets = np.concatenate([offsets[:-1], [offsets[-1] @ tip]])
    lower, upper = np.array([joint.lower for joint in joints]), np.array([joint.upper for joint in joints])
    velocity = np.array([joint.velocity for joint in joints])
    resting = np.array([values[name] for name in joint_names])
    return ArmChain(tuple(joint_names), end_effector, lower, upper, velocity, resting, offsets, axes)


def cache_folder() -> Path:
    """Where folded chains are kept: the user's cache folder."""
    import pooch

    return Path(pooch.os_cache("mild_viz")) / "chains"


def _cached_fold(
    description: Description, joint_names: tuple[str, ...], end_effector: str, values: dict[str, float]
) -> tuple[Float[np.ndarray, "_ 4 4"], Float[np.ndarray, "J 3"]]:
    """`_fold`, read from the cache where it is there and sound, else computed and kept there if possible."""
    resting = [(joint.name, values[joint.name]) for joint in description.path_to(end_effector)]
    question = json.dumps([FOLD_VERSION, description.digest, joint_names, end_effector, resting])
    file = cache_folder() / f"{hashlib.sha256(question.encode()).hexdigest()}.npz"
    n = len(joint_names)
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):  # missing or damaged
        with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as arrays:
            offsets, axes = arrays["offsets"], arrays["axes"]
        if offsets.shape == (n + 1, 4, 4) and axes.shape == (n, 3) and np.isfinite(np.append(offsets, axes)).all():
            return offsets, axes
    offsets, axes = _fold(description, joint_names, end_effector, values)
    with contextlib.suppress(OSError):  # a cache that cannot be written costs time, nothing else
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".tmp", delete=False) as temporary:
            np.savez(temporary, offsets=offsets, axes=axes)
        os.replace(temporary.name, file)
    return offsets, axes


def _fold(
    description: Description, joint_names: tuple[str, ...], end_effector: str, values: dict[str, float]
) -> tuple[Float[np.ndarray, "_ 4 4"], Float[np.ndarray, "J 3"]]:
    """Multiply the fixed transforms between controlled joints, as pytorch-kinematics parses them."""
    import pytorch_kinematics as pk  # slow: it imports torch

    between = description.path_to(end_effector)
    frames = pk.build_serial_chain_from_urdf(_bare(description, between), end_effector, description.root)._serial_frames
    fixed = {joint.name: joint for joint in between}
    offsets, axes = [np.eye(4)], []
    for frame in frames:
        if frame.joint.offset is not None:
            offsets[-1] = offsets[-1] @ _unit(frame.joint.offset.get_matrix()[0].double().numpy())
        if frame.joint.name in joint_names:
            axis = frame.joint.axis.double().numpy()
            axes.append(axis / np.linalg.norm(axis))
            offsets.append(np.eye(4))
        elif frame.joint.joint_type != "fixed":
            joint = fixed[frame.joint.name]
            offsets[-1] = offsets[-1] @ np.linalg.inv(joint.origin) @ joint.motion(values[joint.name])
    return np.array(offsets), np.array(axes)


def _bare(description: Description, joints: tuple[Joint, ...]) -> bytes:
    """The file without all but the places and axes of `joints`: the rest is not needed, and its parser is strict."""
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    robot = etree.fromstring(description.path.read_bytes())
    kept = {("link", description.root), *(("link", joint.child) for joint in joints)}
    kept |= {("joint", joint.name) for joint in joints}
    for part in list(robot):
        if (part.tag, part.get("name")) not in kept:
            robot.remove(part)
            continue
        for detail in list(part):
            if detail.tag not in ("parent", "child", "origin", "axis"):
                part.remove(detail)
        if part.tag == "joint":
            axis = part.find("axis") if part.find("axis") is not None else etree.SubElement(part, "axis")
            axis.set("xyz", axis.get("xyz", "1 0 0"))  # the default of a URDF; pytorch-kinematics takes z
    return etree.tostring(robot)


def _unit(transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The transform with its rotation made orthogonal again (it was parsed in float32)."""
    u, _, v = np.linalg.svd(transform[:3, :3])
    transform[:3, :3] = u @ v
    return transform
