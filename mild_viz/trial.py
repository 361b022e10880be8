"""What was recorded: one interaction (`Trial`), one body (`Skeleton`), a set of trials (`Dataset`)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int

from mild_viz.errors import UserError

ACTIONS = ("wave", "handshake", "rocket", "parachute", "handover")
"""Every action name that a trial may carry."""

CONTACT_ACTIONS = ("handshake", "rocket", "parachute", "handover")
"""Actions in which the partners touch."""

WRIST = "right_wrist"
"""The hand that meets the other's: among the points of every model."""

ARM_POINTS = ("right_shoulder", "right_elbow", WRIST)
"""The points of `Trial.human_arm`, in its order; all body models use these names."""

HAND_POINTS = (WRIST, "left_wrist")
"""What a model of two hands reads."""

PHASES = ("rest", "reach", "contact", "return")
"""Meaning of the integers in `Trial.phase`."""


def freeze_arrays(record: object) -> None:
    """Make every array of a frozen dataclass read-only (copying only those that someone else may write)."""
    for field in fields(record):  # pyright: ignore[reportArgumentType]
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray) and value.flags.writeable:
            value = value.copy()
            value.flags.writeable = False
            object.__setattr__(record, field.name, value)


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Tracked joints of one whole person over time, in that person's own frame.

    `positions` is (T, K, 3) [m], NaN where a joint was not tracked; `bones` are index pairs into `joint_names`.
    """

    joint_names: tuple[str, ...]
    bones: tuple[tuple[int, int], ...]
    positions: Float[np.ndarray, "T K 3"]

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def rows(self, rows: slice) -> Skeleton:
        """Some of its frames."""
        return Skeleton(self.joint_names, self.bones, self.positions[rows])

    def joints(self, names: tuple[str, ...]) -> Float[np.ndarray, "T P 3"]:
        """The positions of some joints [m]; a name that is not there raises a `UserError`."""
        for name in names:
            if name not in self.joint_names:
                raise UserError(f"the skeleton has no joint '{name}'; it has: {', '.join(self.joint_names)}")
        return self.positions[:, [self.joint_names.index(name) for name in names]]


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """Pose over time of an object that is handed over, NaN where it was not tracked; a trial's in the human's frame."""

    positions: Float[np.ndarray, "T 3"]
    """The tracked point of the object [m]."""
    wxyzs: Float[np.ndarray, "T 4"]
    """Unit quaternions: the object's own frame in the human's."""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    def seen_from(self, T_frame_human: Float[np.ndarray, "4 4"]) -> ObjectTrack:
        """The same track in another frame, in which the human's own has the given pose."""
        from scipy.spatial.transform import Rotation  # slow to import, and few recordings have an object

        wxyzs, known = self.wxyzs.copy(), np.isfinite(self.wxyzs).all(axis=1)
        turned = Rotation.from_matrix(T_frame_human[:3, :3]) * Rotation.from_quat(wxyzs[known][:, [1, 2, 3, 0]])
        wxyzs[known] = turned.as_quat()[:, [3, 0, 1, 2]]
        return ObjectTrack(self.positions @ T_frame_human[:3, :3].T + T_frame_human[:3, 3], wxyzs)

    def rows(self, rows: slice) -> ObjectTrack:
        """Some of its frames."""
        return ObjectTrack(self.positions[rows], self.wxyzs[rows])


@dataclass(frozen=True, eq=False)
class Trial:
    """One recorded interaction of a human with a partner (a second human, or a robot).

    Positions are metres in the person's own frame (x forward, y left, z up); NaN marks a frame in which
    the joint was not tracked. Arms are right arms: shoulder, elbow, wrist.
    """

    dataset: str
    split: str
    index: int
    action: str
    rate: float
    """Frames a second [Hz]."""
    human_arm: Float[np.ndarray, "T 3 3"]
    partner_arm: Float[np.ndarray, "T 3 3"] | None = None
    """The second human's right arm, in the second human's own frame."""
    robot_joints: Float[np.ndarray, "T J"] | None = None
    """Recorded robot joints [rad], in the order of `robot_joint_names`."""
    robot_joint_names: tuple[str, ...] = ()
    human_skeleton: Skeleton | None = None
    partner_skeleton: Skeleton | None = None
    T_world_human: Float[np.ndarray, "4 4"] | None = None
    """Pose of the human's own frame in one world frame; None where each person was recorded apart."""
    T_world_partner: Float[np.ndarray, "4 4"] | None = None
    object_track: ObjectTrack | None = None
    """What is handed over, where it was recorded."""
    phase: Int[np.ndarray, " T"] | None = None
    """True phase of every frame (index into `PHASES`), where it is known."""
    active: Int[np.ndarray, " T"] | None = None
    """1 where the recording's own labels say that the action is going on (HRI-Yumi)."""
    points: tuple[str, ...] = ARM_POINTS
    """What a model reads of the human, and of a second human: the arm, or joints of the skeletons."""

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise UserError(f"trial {self.name}: action '{self.action}' is unknown; valid: {', '.join(ACTIONS)}")
        n_frames = len(self.human_arm)
        for label in ("partner_arm", "robot_joints", "phase", "active"):
            value = getattr(self, label)
            if value is not None and len(value) != n_frames:
                raise UserError(f"trial {self.name}: {label} has {len(value)} frames, human_arm has {n_frames}")
        if self.object_track is not None and len(self.object_track.positions) != n_frames:
            raise UserError(
                f"trial {self.name}: object_track has {len(self.object_track.positions)} frames, "
                f"human_arm has {n_frames}"
            )
        freeze_arrays(self)

    @property
    def name(self) -> str:
        return f"{self.dataset}/{self.split}/{self.index}"

    @property
    def n_frames(self) -> int:
        return len(self.human_arm)

    @property
    def human_points(self) -> Float[np.ndarray, "T P 3"]:
        """Where the human's `points` are [m], in the human's own frame."""
        points = self._points(self.human_arm, self.human_skeleton)
        if points is None:
            raise UserError(f"trial {self.name} has no skeleton, which {', '.join(self.points)} would be read from")
        return points

    @property
    def partner_points(self) -> Float[np.ndarray, "T P 3"] | None:
        """The same of the second human, in that person's own frame; None where there is none."""
        return self._points(self.partner_arm, self.partner_skeleton)

    def _points(
        self, arm: Float[np.ndarray, "T 3 3"] | None, skeleton: Skeleton | None
    ) -> Float[np.ndarray, "T P 3"] | None:
        if self.points == ARM_POINTS:
            return arm
        return None if skeleton is None else skeleton.joints(self.points)


@dataclass(frozen=True, eq=False)
class Dataset:
    """All trials of one source, split as the source splits them."""

    name: str
    title: str
    """What it is, in one line for people."""
    train: tuple[Trial, ...]
    test: tuple[Trial, ...]
    checksum: str
    """SHA-256 of what the trials were read or generated from."""

    @property
    def actions(self) -> tuple[str, ...]:
        """The actions that occur, in the order of `ACTIONS`."""
        present = {trial.action for trial in self.train + self.test}
        return tuple(action for action in ACTIONS if action in present)

    def split(self, name: str) -> tuple[Trial, ...]:
        """The trials of split `name` ('train' or 'test')."""
        if name not in ("train", "test"):
            raise UserError(f"split '{name}' is unknown; valid: train, test")
        return self.train if name == "train" else self.test

    def trial(self, split: str, index: int) -> Trial:
        """Trial `index` of a split."""
        trials = self.split(split)
        if not 0 <= index < len(trials):
            raise UserError(f"{self.name}/{split} has no trial {index}; valid: 0 to {len(trials) - 1}")
        return trials[index]
