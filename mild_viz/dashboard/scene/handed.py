"""The object of a handover: in the robot's hand until the recorded transfer, then as recorded, with the receiver.

Nobody recorded a robot that holds it. So it is drawn where the robot would have it: fixed to the hand, gripped where
the recorded giver holds it, and turned such that at the transfer it stands as recorded. A robot that is not where
the giver's hand was lets it jump to the receiver there, by what it misses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Float

from mild_viz.dashboard.scene.ghost import moving_links
from mild_viz.dashboard.scene.labels import NOTE, add_label
from mild_viz.dashboard.scene.palette import Palette
from mild_viz.dashboard.scene.shapes import Mesh, loft
from mild_viz.rollout import Rollout

ROOT = "/object"

RADIUS, HEIGHT = 0.04, 0.20
"""Size [m] of the bottle that is drawn, below the tracked point. The object's own was not recorded; the recording's own
viewer draws a cylinder of this radius whose middle is 10 cm below that point."""

GRIP = 0.15
"""How far below the tracked point the giver's hand is [m]: 0.17 over the training trials, the receiver's 0.12."""

RECORDED = "object, as recorded"


@dataclass(frozen=True, eq=False)
class HandedFrames:
    """Where the object is drawn, world."""

    positions: Float[np.ndarray, "N 3"]
    """Its tracked point [m]; NaN where it was not tracked."""
    wxyzs: Float[np.ndarray, "N 4"]
    transfer: int
    """Frames before this one show it in the robot's hand; 0 where there is no robot to hold it."""


def handed_frames(rollout: Rollout, in_hand: bool = True) -> HandedFrames | None:
    """Poses of the object over a rollout; None where none was recorded. Not `in_hand`: all as recorded."""
    track, transfer = rollout.object_track, rollout.inference.transfer
    if track is None or not np.isfinite(track.wxyzs).all(axis=1).any():
        return None
    if not in_hand or transfer is None or not moving_links(rollout.link_poses):
        return HandedFrames(track.positions, track.wxyzs, 0)
    from scipy.spatial.transform import Rotation  # slow to import, and few recordings have an object

    known = np.flatnonzero(np.isfinite(track.wxyzs).all(axis=1))
    nearest = known[np.abs(known - transfer).argmin()]
    hand = Rotation.from_quat(rollout.link_poses[:, hand_link(rollout), [1, 2, 3, 0]])
    held = hand * hand[nearest].inv() * Rotation.from_quat(track.wxyzs[nearest, [1, 2, 3, 0]])
    before = np.arange(len(track.positions)) < transfer
    top = rollout.end_effector + held.apply([0.0, 0.0, GRIP])
    return HandedFrames(
        np.where(before[:, None], top, track.positions),
        np.where(before[:, None], held.as_quat()[:, [3, 0, 1, 2]], track.wxyzs),
        transfer,
    )


def hand_link(rollout: Rollout) -> int:
    """The drawn link that carries the end effector: nearest to it of those that move, at a fixed distance."""
    moving = list(moving_links(rollout.link_poses))
    distance = np.linalg.norm(rollout.link_poses[:, moving, 4:] - rollout.end_effector[:, None], axis=2)
    rigid = np.ptp(distance, axis=0) < 1e-3
    return moving[int(np.where(rigid, distance[0], distance[0] + 1e3).argmin())]


class HandedView:
    """A bottle, and a word on whose hand it is drawn in."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._frame = server.scene.add_frame(ROOT, show_axes=False, visible=False)
        self._bottle = server.scene.add_mesh_simple(
            f"{ROOT}/bottle", *bottle(), cast_shadow=False, receive_shadow=False
        )
        self._label = add_label(server, f"{ROOT}/label", "", NOTE, "bottom-center")
        self._label.position = (0.0, 0.0, 0.03)
        self._frames: HandedFrames | None = None

    def show(self, frames: HandedFrames | None, time: Float[np.ndarray, " N"], colors: Palette) -> None:
        """Take over where the object is, and the times of the frames [s]; None hides it."""
        self._frames = frames
        self._held = "" if frames is None else f"object, held until {time[frames.transfer]:.1f} s"
        self._bottle.color = colors.object
        self._frame.visible = False

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        frames = self._frames
        if frames is None:
            return
        pose = np.concatenate([frames.wxyzs[n], frames.positions[n]])
        self._frame.visible = bool(np.isfinite(pose).all())
        if self._frame.visible:
            self._frame.wxyz, self._frame.position = pose[:4], pose[4:]
            self._label.text = self._held if n < frames.transfer else RECORDED


def bottle() -> Mesh:
    """A bottle that hangs from the origin, with a cap [m]."""
    sections = np.array(
        [
            (-1.0, 0.94), (-0.985, 1.0), (-0.34, 1.0), (-0.27, 0.94), (-0.17, 0.50), (-0.13, 0.42), (-0.12, 0.50),
            (-0.01, 0.50), (0.0, 0.46),
        ]
    )  # fmt: skip
    z, radius = HEIGHT * sections[:, 0], RADIUS * sections[:, 1]
    return loft(np.stack([z, radius, radius, 0.0 * z, 0.0 * z], axis=1), sides=36)
