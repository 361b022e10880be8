"""Where the object of a handover is when the robot takes the giver's place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.robot.contact import in_frame
from mild_viz.trial import ObjectTrack, freeze_arrays

OBJECT_LENGTH = 0.27
"""How far the object reaches below its tracked point [m]: to where recorded givers hold it; its shape is unknown."""


@dataclass(frozen=True, eq=False)
class CarriedObject:
    """An object over a rollout of N windows, in world."""

    poses: Float[np.ndarray, "N 7"]
    """wxyz, xyz [m] of its tracked point; it reaches `OBJECT_LENGTH` below, along its own z. NaN where unknown."""
    by_robot: Bool[np.ndarray, " N"]
    """Whether the robot holds it; else it is where it was recorded, seen from the human who receives it."""

    def __post_init__(self) -> None:
        freeze_arrays(self)


def carry_object(
    track: ObjectTrack,
    handed_over: int,
    T_world_human: Float[np.ndarray, "4 4"],
    end_effector: Float[np.ndarray, "N 3"],
    hand_wxyzs: Float[np.ndarray, "N 4"],
) -> CarriedObject:
    """The object in the robot's hand until row `handed_over` of the track, and from then on where it was recorded.

    The robot's hand is elsewhere than the recorded giver's, so that the recorded place would float in the air. The
    object therefore moves rigidly with the robot's hand. It is held such that it has its recorded orientation in the
    moment of the transfer, at the point of its axis that is nearest to the robot's hand then: if the hands meet, it
    does not jump.

    Args:
        track: In the human's own frame.
        end_effector: Place of the robot's hand in world [m].
        hand_wxyzs: Its orientation in world.
    """
    from scipy.spatial.transform import Rotation  # only trials with an object need it

    positions = in_frame(T_world_human, track.positions)
    wxyzs = np.full((len(positions), 4), np.nan)
    known = np.isfinite(track.positions).all(axis=1) & np.isfinite(track.wxyzs).all(axis=1)
    if known.any():
        human = Rotation.from_matrix(T_world_human[:3, :3])
        wxyzs[known] = _wxyz(human * _rotation(track.wxyzs[known]))
    by_robot = np.zeros(len(positions), dtype=bool)
    moments = np.flatnonzero(known)
    if len(moments) and handed_over > 0:
        moment = int(moments[np.abs(moments - handed_over).argmin()])
        held = slice(0, handed_over)
        there = _rotation(wxyzs[moment])
        down = there.apply([0.0, 0.0, -1.0])
        below = np.clip((end_effector[moment] - positions[moment]) @ down, 0.0, OBJECT_LENGTH)
        turn = _rotation(hand_wxyzs[held]) * _rotation(hand_wxyzs[moment]).inv()
        wxyzs[held] = _wxyz(turn * there)
        positions[held] = end_effector[held] - turn.apply(below * down)
        by_robot[held] = True
    return CarriedObject(np.concatenate([wxyzs, positions], axis=1), by_robot)


def _rotation(wxyz: Float[np.ndarray, "*N 4"]):
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(wxyz[..., [1, 2, 3, 0]])


def _wxyz(rotation) -> Float[np.ndarray, "*N 4"]:
    return rotation.as_quat()[..., [3, 0, 1, 2]]
