"""The robot: solid as commanded, and a translucent ghost of the decoded motion where IK changed it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
import viser
from jaxtyping import Bool, Float

from mild_viz.dashboard.scene.ghost import GhostArm, moving_links
from mild_viz.dashboard.scene.labels import add_title
from mild_viz.dashboard.scene.palette import Palette
from mild_viz.dashboard.scene.shapes import rotate
from mild_viz.rollout import Rollout

ROOT = "/robot"

GHOST_OPACITY = 0.45

GHOST_FROM = 0.015
"""Nearer than this [m] to the command the ghost is left out: it would only veil the solid arm."""


@dataclass(frozen=True, eq=False)
class RobotFrames:
    """What the robot view draws of one rollout."""

    poses: Float[np.ndarray, "N L 7"]
    ghost_poses: Float[np.ndarray, "N L 7"]
    moving: tuple[int, ...]
    """Links whose pose changes at all; the others are set once."""
    ghost_moving: tuple[int, ...]
    ghost_visible: Bool[np.ndarray, " N"]


def robot_frames(rollout: Rollout) -> RobotFrames:
    """Pick the links that move, and the frames in which the ghost differs from the command."""
    gap = np.linalg.norm(rollout.end_effector_decoded - rollout.end_effector, axis=1)
    solid, ghost = moving_links(rollout.link_poses), moving_links(rollout.link_poses_decoded)
    return RobotFrames(rollout.link_poses, rollout.link_poses_decoded, solid, ghost, gap > GHOST_FROM)


class RobotView:
    """One node per link, posed from the rollout."""

    def __init__(
        self, server: viser.ViserServer, visuals: dict[str, trimesh.Trimesh], link_names: tuple[str, ...], title: str
    ) -> None:
        self._frame = server.scene.add_frame(ROOT, show_axes=False)
        self._ghost = GhostArm(server, f"{ROOT}/ghost", visuals, link_names, GHOST_OPACITY)
        self._title, self._caption = add_title(server, ROOT, f"Robot: {title}")
        self._visuals = {i: visuals[link] for i, link in enumerate(link_names) if link in visuals}
        self._solid = {
            i: server.scene.add_mesh_trimesh(
                f"{ROOT}/solid/{link_names[i]}", mesh, cast_shadow=False, receive_shadow=False
            )
            for i, mesh in self._visuals.items()
        }
        self._frames: RobotFrames | None = None
        self._bounds: Float[np.ndarray, "2 3"] | None = None

    def remove(self) -> None:
        """Take everything out of the scene."""
        self._ghost.remove()
        self._frame.remove()

    def bounds(self, rollout: Rollout) -> Float[np.ndarray, "2 3"]:
        """Lowest and highest corner of the links that stand still (of all, where every link moves), in world [m]."""
        if self._bounds is None:
            poses, moving = rollout.link_poses[0], moving_links(rollout.link_poses)
            still = [i for i in self._visuals if i not in moving] or list(self._visuals)
            corners = {i: trimesh.bounds.corners(self._visuals[i].bounds) for i in still}
            points = np.concatenate([rotate(poses[i, :4], corners[i]) + poses[i, 4:] for i in still])
            self._bounds = np.stack([points.min(0), points.max(0)])
        return self._bounds

    def show(
        self,
        frames: RobotFrames,
        title: Float[np.ndarray, " 3"],
        controller: str,
        colors: Palette,
        visible: bool,
        ghost: bool,
    ) -> None:
        """Take over the poses of a rollout."""
        self._frames = frames
        self._frame.visible = visible
        self._show_ghost = ghost and bool(frames.ghost_visible.any())
        self._ghost.show(frames.ghost_poses, frames.ghost_moving, colors.prediction)
        # Those that move follow with the frame.
        still = tuple(i for i in range(frames.poses.shape[1]) if i not in frames.moving)
        self._pose(still, frames.poses[0])
        self._title.position = self._caption.position = title
        self._caption.text = f"{controller} command" + (" · pale: decoded, before IK" if self._show_ghost else "")

    def show_command(self, poses: Float[np.ndarray, "N L 7"], caption: str) -> None:
        """Draw these poses of the same links as the command, under this caption, until the next `show`."""
        self._caption.text = caption
        if self._frames is not None and poses is not self._frames.poses:
            moving = tuple(sorted({*self._frames.moving, *moving_links(poses)}))
            self._frames = replace(self._frames, poses=poses, moving=moving)

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        frames = self._frames
        if frames is None:
            return
        self._pose(frames.moving, frames.poses[n])
        self._ghost.visible = self._show_ghost and bool(frames.ghost_visible[n])
        self._ghost.set_frame(n)

    def _pose(self, links: tuple[int, ...], poses: Float[np.ndarray, "L 7"]) -> None:
        for i in links:
            handle = self._solid.get(i)
            if handle is not None:
                handle.wxyz, handle.position = poses[i, :4], poses[i, 4:]
