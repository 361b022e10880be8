"""Names and bones of the tracked bodies, and the frame of one person."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.trial import ARM_POINTS, Skeleton

ARM_JOINTS = ARM_POINTS
"""The joints of `Trial.human_arm`, in its order, which every body model here has."""

NUITRACK_JOINTS = (
    "head", "neck", "torso", "waist",
    "left_collar", "left_shoulder", "left_elbow", "left_wrist", "left_hand",
    "right_collar", "right_shoulder", "right_elbow", "right_wrist", "right_hand",
)  # fmt: skip
"""The upper body as Nuitrack names it. Its two collar joints coincide, between the shoulders."""

NUITRACK_IDS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 15)
"""Nuitrack's own number of each of `NUITRACK_JOINTS`."""

ZED_JOINTS = (
    "pelvis", "naval_spine", "chest_spine", "neck",
    "left_clavicle", "left_shoulder", "left_elbow", "left_wrist", "left_hand", "left_handtip", "left_thumb",
    "right_clavicle", "right_shoulder", "right_elbow", "right_wrist", "right_hand", "right_handtip", "right_thumb",
    "left_hip", "left_knee", "left_ankle", "left_foot", "right_hip", "right_knee", "right_ankle", "right_foot",
    "head", "nose", "left_eye", "left_ear", "right_eye", "right_ear", "left_heel", "right_heel",
)  # fmt: skip
"""The 34 joints of the ZED SDK's BODY_34, in its order."""


def joint_indices(joint_names: tuple[str, ...], wanted: tuple[str, ...]) -> list[int]:
    """Where each of `wanted` stands in `joint_names`; a name that is not there raises a `UserError`."""
    for name in wanted:
        if name not in joint_names:
            raise UserError(f"the skeleton has no joint '{name}'; it has: {', '.join(joint_names)}")
    return [joint_names.index(name) for name in wanted]


def bones_along(joint_names: tuple[str, ...], *chains: str) -> tuple[tuple[int, int], ...]:
    """Index pairs of neighbouring joints along chains of names, each written with spaces between."""
    bones: list[tuple[int, int]] = []
    for chain in chains:
        indices = joint_indices(joint_names, tuple(chain.split()))
        bones += list(zip(indices[:-1], indices[1:], strict=True))
    return tuple(bones)


NUITRACK_BONES = bones_along(
    NUITRACK_JOINTS,
    "head neck right_collar torso waist",
    "left_collar left_shoulder left_elbow left_wrist left_hand",
    "right_collar right_shoulder right_elbow right_wrist right_hand",
)

ZED_BONES = bones_along(
    ZED_JOINTS,
    "pelvis naval_spine chest_spine neck head nose",
    "neck left_clavicle left_shoulder left_elbow left_wrist left_hand left_handtip",
    "left_wrist left_thumb",
    "neck right_clavicle right_shoulder right_elbow right_wrist right_hand right_handtip",
    "right_wrist right_thumb",
    "pelvis left_hip left_knee left_ankle left_foot left_heel left_ankle",
    "pelvis right_hip right_knee right_ankle right_foot right_heel right_ankle",
    "nose left_eye left_ear",
    "nose right_eye right_ear",
)


def person_frame(
    left_shoulder: Float[np.ndarray, " 3"],
    right_shoulder: Float[np.ndarray, " 3"],
    waist: Float[np.ndarray, " 3"],
    origin: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "4 4"]:
    """T_world_person from four joints of one frame, in world [m]: x forward, y to the person's left, z up.

    As NuiSI defines it: y runs along the shoulders, x is normal to the torso (shoulders and waist), so z is
    the torso's own up and leans with it. `origin` is the joint to stand at (there: the collar).
    """
    y = left_shoulder - right_shoulder
    x = np.cross(waist - right_shoulder, y)
    lengths = np.linalg.norm(y), np.linalg.norm(x)
    if not np.isfinite(lengths).all() or min(lengths) < 1e-6:
        raise UserError(
            "a person's own frame needs both shoulders, the waist and the neck or collar, "
            "tracked and apart in one frame at least"
        )
    y, x = y / lengths[0], x / lengths[1]
    T_world_person = np.eye(4)
    T_world_person[:3, :3] = np.stack([x, y, np.cross(x, y)], axis=1)
    T_world_person[:3, 3] = origin
    return T_world_person


def first_person_frame(body: Float[np.ndarray, "T K 3"], reference: list[int]) -> Float[np.ndarray, "4 4"]:
    """`person_frame` from the first frame in which all four `reference` joints of a body [m] are tracked."""
    joints = body[:, reference]
    tracked = np.isfinite(joints).all(axis=(1, 2))
    return person_frame(*joints[tracked.argmax()])


REFERENCE_JOINTS = ("left_shoulder", "right_shoulder", "pelvis", "neck")
"""What sets a person's own frame in a ZED body: its neck is where Nuitrack has the collar, between the shoulders."""


def own_frame(
    body: Float[np.ndarray, "T K 3"], joints: tuple[str, ...], bones: tuple[tuple[int, int], ...]
) -> tuple[Float[np.ndarray, "4 4"], Skeleton]:
    """T_world_person from the first frame in which a body [m] is tracked (`REFERENCE_JOINTS`), and the body in it."""
    T_world_person = first_person_frame(body, joint_indices(joints, REFERENCE_JOINTS))
    return T_world_person, Skeleton(joints, bones, to_frame(T_world_person, body))


def to_frame(T_world_frame: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
    """Points given in world, expressed in `frame`."""
    return (points - T_world_frame[:3, 3]) @ T_world_frame[:3, :3]


def to_world(T_world_frame: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
    """Points given in `frame`, expressed in world."""
    return points @ T_world_frame[:3, :3].T + T_world_frame[:3, 3]
