"""Poses of every drawn part of the human over a whole rollout, in the human's own frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.dashboard.scene import body
from mild_viz.dashboard.scene.shapes import limb_poses, quaternion_from_matrix
from mild_viz.rollout import Inference
from mild_viz.trial import Skeleton

ARM = ("right_shoulder", "right_elbow", "right_wrist")

FACE = ("nose", "left_eye", "right_eye", "left_ear", "right_ear")
"""Tracked points of the head that are drawn as small dots, without bones."""

LEGS = ("_knee", "_ankle", "_foot", "_heel")

ARM_RADII = (0.050, 0.041, 0.046)
ARM_BONE_RADII = (0.040, 0.033)

WALKS_FROM = 0.5
"""Whose head wanders farther than this [m] walks: title and picture then follow."""

CALM = 9
"""Frames over which a title that follows a head is averaged."""


@dataclass(frozen=True, eq=False)
class Figure:
    """Limbs and balls that were observed (NaN gaps have scale zero), and the poses of the schematic parts."""

    limb_positions: Float[np.ndarray, "N P 3"]
    limb_wxyzs: Float[np.ndarray, "N P 4"]
    limb_scales: Float[np.ndarray, "N P 3"]
    limb_feeds: Bool[np.ndarray, " P"]
    """Whether the limb belongs to the arm that feeds the model."""
    ball_positions: Float[np.ndarray, "N Q 3"]
    ball_scales: Float[np.ndarray, "N Q 3"]
    ball_feeds: Bool[np.ndarray, " Q"]
    torso_poses: Float[np.ndarray, "N 7"]
    """wxyz, xyz of the middle of the shoulders."""
    head_positions: Float[np.ndarray, "N 3"]
    height: float
    """Stature [m]."""
    whole: bool
    """A skeleton was recorded, not only the arm."""
    soles: Float[np.ndarray, " 3"] | None = None
    """Where the recorded feet stand; None where no legs were recorded."""

    @property
    def shoulders(self) -> Float[np.ndarray, " 3"]:
        """The middle of the shoulders, over the rollout."""
        return np.median(self.torso_poses[:, 4:], axis=0)

    @property
    def crown(self) -> Float[np.ndarray, " 3"]:
        """The top of the head, over the rollout."""
        head = np.median(self.head_positions, axis=0)
        away = head - self.shoulders
        return head + away / max(float(np.linalg.norm(away)), 1e-6) * body.HEAD_RADIUS_SHARE * self.height

    @cached_property
    def walks(self) -> bool:
        """Whether the person walks, rather than sways."""
        return float(np.ptp(self.head_positions, axis=0).max()) > WALKS_FROM

    @cached_property
    def crowns(self) -> Float[np.ndarray, "N 3"]:
        """The top of the head in every frame; one place for somebody who does not walk."""
        away = self.head_positions - np.median(self.head_positions, axis=0)
        return self.crown + (smoothed(away) if self.walks else np.zeros_like(away))


def make_figure(inference: Inference) -> Figure:
    """All poses of one recording."""
    height = body.stature(inference.human_arm)
    skeleton = inference.human_skeleton
    if skeleton is None or not set(ARM) <= set(skeleton.joint_names):
        return arm_figure(inference.human_arm, height)
    return skeleton_figure(skeleton, height)


def partner_figure(inference: Inference) -> Figure | None:
    """All poses of the giver of a handover, in that person's own frame; None without one, or without a whole skeleton.

    Without the legs: those of the handovers' givers were guessed by the tracker (knees straight to half a degree,
    feet up to half a metre above the other's floor), and the recording's own viewer leaves them out too.
    """
    skeleton = inference.partner_skeleton
    if inference.action != "handover" or skeleton is None or not set(ARM) <= set(skeleton.joint_names):
        return None
    skeleton = without(skeleton, LEGS)
    arm = skeleton.positions[:, [skeleton.joint_names.index(name) for name in ARM]]
    return skeleton_figure(skeleton, body.stature(arm))


def without(skeleton: Skeleton, parts: tuple[str, ...]) -> Skeleton:
    """A skeleton without the joints of both sides that are named so."""
    kept = [i for i, name in enumerate(skeleton.joint_names) if not name.endswith(parts)]
    bones = tuple((kept.index(a), kept.index(b)) for a, b in skeleton.bones if a in kept and b in kept)
    return Skeleton(tuple(skeleton.joint_names[i] for i in kept), bones, skeleton.positions[:, kept])


def arm_figure(arm: Float[np.ndarray, "N 3 3"], height: float) -> Figure:
    """Only the arm was recorded: the rest of the person is built from where its shoulder is."""
    with_shoulder = arm[np.isfinite(arm[:, 0]).all(1), 0]
    shoulder = np.median(with_shoulder, axis=0) if len(with_shoulder) else np.zeros(3)
    middle = shoulder + [0.0, body.SHOULDER_SHARE * height, 0.0]
    poses = np.tile(np.concatenate([[1.0, 0.0, 0.0, 0.0], middle]), (len(arm), 1))
    heads = np.tile(middle + [0.01 * height, 0.0, body.HEAD_SHARE * height], (len(arm), 1))
    return assemble(arm, ((0, 1), (1, 2)), np.array(ARM_BONE_RADII), np.array(ARM_RADII), poses, heads, height)


def skeleton_figure(skeleton: Skeleton, height: float) -> Figure:
    """The whole skeleton was recorded: bones as given, torso and head carried by its joints."""
    names, positions = skeleton.joint_names, skeleton.positions
    arm = [names.index(name) for name in ARM]
    bones = tuple((a, b) for a, b in skeleton.bones if names[a] not in FACE and names[b] not in FACE)
    feeding = [{arm[0], arm[1]}, {arm[1], arm[2]}]
    bone_radii = np.array([ARM_BONE_RADII[feeding.index({a, b})] if {a, b} in feeding else 0.021 for a, b in bones])
    radii = np.array([0.012 if name in FACE else 0.027 for name in names])
    radii[arm] = ARM_RADII
    poses = torso_poses(skeleton)
    return assemble(
        positions, bones, bone_radii, radii, poses, held(heads(skeleton, poses, height)), height, arm,
        soles(skeleton, height),
    )  # fmt: skip


def heads(skeleton: Skeleton, poses: Float[np.ndarray, "N 7"], height: float) -> Float[np.ndarray, "N 3"]:
    """The middle of the head: between the ears where they were tracked (what is called head then is the chin's)."""
    names, positions = skeleton.joint_names, skeleton.positions
    if {"left_ear", "right_ear"} <= set(names):
        return 0.5 * (positions[:, names.index("left_ear")] + positions[:, names.index("right_ear")])
    return positions[:, names.index("head")] if "head" in names else poses[:, 4:] + [0.0, 0.0, body.HEAD_SHARE * height]


def torso_poses(skeleton: Skeleton) -> Float[np.ndarray, "N 7"]:
    """Pose of the shoulders' middle: y along the shoulders, z from the hips up; a gap holds the last pose."""
    names, positions = skeleton.joint_names, skeleton.positions
    left, right = (positions[:, names.index(f"{side}_shoulder")] for side in ("left", "right"))
    base = next((name for name in ("waist", "pelvis") if name in names), None)
    middle = held(0.5 * (left + right))
    up = middle - held(positions[:, names.index(base)]) if base else np.tile([0.0, 0.0, 1.0], (len(middle), 1))
    y = unit(held(left - right))
    x = unit(np.cross(y, up))
    return np.concatenate([quaternion_from_matrix(np.stack([x, y, np.cross(x, y)], axis=2)), middle], axis=1)


def soles(skeleton: Skeleton, height: float) -> Float[np.ndarray, " 3"] | None:
    """Below the recorded ankles, where the standing foot ends; None without ankles."""
    if "left_ankle" not in skeleton.joint_names:
        return None
    ankles = [skeleton.positions[:, skeleton.joint_names.index(f"{side}_ankle")] for side in ("left", "right")]
    points = np.concatenate(ankles)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return None
    return np.median(points, axis=0) - [0.0, 0.0, body.ANKLE_SHARE * height]


def assemble(
    positions: Float[np.ndarray, "N K 3"],
    bones: tuple[tuple[int, int], ...],
    bone_radii: Float[np.ndarray, " P"],
    ball_radii: Float[np.ndarray, " K"],
    poses: Float[np.ndarray, "N 7"],
    heads: Float[np.ndarray, "N 3"],
    height: float,
    arm: list[int] | None = None,
    feet: Float[np.ndarray, " 3"] | None = None,
) -> Figure:
    """Lay limbs along the bones and balls on the joints of every frame."""
    n_frames, n_joints = positions.shape[:2]
    starts, ends = [a for a, _ in bones], [b for _, b in bones]
    start, end = positions[:, starts].reshape(-1, 3), positions[:, ends].reshape(-1, 3)
    wxyzs, scales = limb_poses(start, end, np.tile(bone_radii, n_frames))
    seen = np.isfinite(positions.sum(axis=2))
    arm_joints = [0, 1, 2] if arm is None else arm
    feeding = [{arm_joints[0], arm_joints[1]}, {arm_joints[1], arm_joints[2]}]
    shape = (n_frames, len(bones))
    return Figure(
        limb_positions=np.nan_to_num(start).reshape(*shape, 3),
        limb_wxyzs=wxyzs.reshape(*shape, 4),
        limb_scales=scales.reshape(*shape, 3),
        limb_feeds=np.array([{a, b} in feeding for a, b in bones]),
        ball_positions=np.nan_to_num(positions),
        ball_scales=np.where(seen, ball_radii, 0.0)[..., None].repeat(3, axis=2),
        ball_feeds=np.isin(np.arange(n_joints), arm_joints),
        torso_poses=poses,
        head_positions=heads,
        height=height,
        whole=arm is not None,
        soles=feet,
    )


def held(values: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Each missing row repeats the last one that was seen; those before the first repeat the first."""
    seen = np.isfinite(values).all(1)
    if not seen.any():
        return np.zeros_like(values)
    last = np.maximum.accumulate(np.where(seen, np.arange(len(values)), -1))
    return values[np.where(last < 0, seen.argmax(), last)]


def smoothed(track: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Mean over the `CALM` frames about each, fewer at the ends."""
    weights = np.ones(min(CALM, len(track)))
    counts = np.convolve(np.ones(len(track)), weights, mode="same")
    return np.stack([np.convolve(column, weights, mode="same") for column in track.T], axis=1) / counts[:, None]


def unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Vectors of length one; a zero vector stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0.0, length, 1.0)
