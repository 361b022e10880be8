"""The scene of live operation: the views of playback, whose single frame is written anew for every snapshot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import viser
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.dashboard.live.template import resting_rollout
from mild_viz.dashboard.scene.figure import Figure, arm_figure, skeleton_figure
from mild_viz.dashboard.scene.latent import OPACITY_FLOOR, OPACITY_RANGE, TRACES, TRAIL, LatentFrames
from mild_viz.dashboard.scene.palette import palette
from mild_viz.dashboard.scene.robot import GHOST_FROM, RobotFrames, robot_frames
from mild_viz.dashboard.scene.scene import Scene
from mild_viz.dashboard.view import ViewSettings
from mild_viz.live.feed import Snapshot
from mild_viz.live.onset import INTERACTING
from mild_viz.live.person import skeleton_bones
from mild_viz.live.setup import NOMINAL_ARM
from mild_viz.robot.model import RobotModel
from mild_viz.settings import ControlSettings
from mild_viz.trial import Skeleton

MOVED = ("limb_positions", "limb_wxyzs", "limb_scales", "ball_positions", "ball_scales", "torso_poses",
         "head_positions")  # fmt: skip
"""What of a figure is written anew for every snapshot."""


class LiveScene(Scene):
    """Draws snapshots. `follow` may be called from one thread, the cameras from another."""

    def __init__(
        self,
        server: viser.ViserServer,
        checkpoint: Checkpoint,
        variant: str,
        action: str,
        robot: RobotModel,
        settings: ControlSettings,
        T_world_human: Float[np.ndarray, "4 4"],
    ) -> None:
        super().__init__(server, robot, dark=False)
        self._model, self._variant, self._action = checkpoint, variant, action
        self._arm_model, self._settings, self._T_world_human = robot, settings, T_world_human
        self._names: tuple[str, ...] | None = None
        self._seen: Float[np.ndarray, "K 3"] = np.full((0, 3), np.nan)
        """Where each joint was last seen."""
        self._interaction = 0
        self._lay_out(NOMINAL_ARM, None)

    def follow(self, now: Snapshot) -> None:
        """Draw one snapshot."""
        self._learn_body(now)
        figure = self._pose(now)
        poses = self._arm_model.link_poses(now.commanded[None], self._action)
        ghost = None
        if now.phase == INTERACTING and np.isfinite(now.decoded).all():
            ends = self._arm_model.end_effector(np.stack([now.commanded, now.decoded]))
            if np.linalg.norm(ends[0] - ends[1]) > GHOST_FROM:
                ghost = self._arm_model.link_poses(now.decoded[None], self._action)
        self._think(now)
        with self._lock, self._server.atomic():
            if figure is not None:
                for name in MOVED:
                    getattr(self._live_figure, name)[0] = getattr(figure, name)[0]
            self._live_tracked[0] = bool(np.isfinite(now.arm).all())
            frames = self._live_robot
            frames.poses[0] = poses[0]
            frames.ghost_visible[0] = ghost is not None
            if ghost is not None:
                frames.ghost_poses[0] = ghost[0]
            self._human.set_frame(0)
            self._robot.set_frame(0)
            self._latent.set_frame(TRAIL)

    def _lay_out(self, arm: Float[np.ndarray, "3 3"], skeleton: Skeleton | None) -> None:
        """Lay the scene out for a person of this size, and take over the frames that the views draw."""
        view = ViewSettings()
        rollout = resting_rollout(
            self._model, self._variant, self._action, self._arm_model, self._settings, self._T_world_human, arm,
            skeleton,
        )  # fmt: skip
        self.show(rollout, view)
        assert self._figure is not None and self._latent_frames is not None and self._layout is not None
        colors, layout = palette(view.dark), self._layout
        whole = robot_frames(rollout)
        self._live_figure = first_row(self._figure)
        self._live_tracked = np.zeros(1, dtype=bool)
        self._live_robot = RobotFrames(
            whole.poses[:1].copy(), whole.ghost_poses[:1].copy(), whole.moving, whole.ghost_moving, np.ones(1, bool)
        )
        self._live_latent = empty_plot(self._latent_frames)
        with self._lock, self._server.atomic():
            self._reach.show(rollout, colors, False)  # it marks the resting hand, not the one that comes
            self._human.show(self._live_figure, self._T_world_human, layout.floor, colors, True, self._live_tracked)
            self._robot.show(self._live_robot, layout.robot_title, self._settings.controller, colors, True, True)
            self._latent.show(self._live_latent, layout, colors, True)

    def _learn_body(self, now: Snapshot) -> None:
        """Lay out anew when other joints come than before, once the body is seen whole."""
        if now.positions is None or now.names == self._names:
            return
        if not (np.isfinite(now.arm).all() and np.isfinite(now.positions).all()):
            return
        self._names, self._seen = now.names, now.positions.copy()
        self._lay_out(now.arm, self._skeleton(now.positions))

    def _skeleton(self, positions: Float[np.ndarray, "K 3"]) -> Skeleton | None:
        assert self._names is not None
        bones = skeleton_bones(self._names)
        return Skeleton(self._names, bones, positions[None]) if bones else None

    def _pose(self, now: Snapshot) -> Figure | None:
        """The figure of a snapshot; None where nothing new was seen. Trunk and head stay where they were last seen."""
        if self._names is None:
            return None
        height = self._live_figure.height
        if now.positions is None or now.names != self._names:
            return None
        seen = np.isfinite(now.positions).all(axis=1)
        self._seen[seen] = now.positions[seen]
        skeleton = self._skeleton(now.positions)
        if skeleton is None:
            return arm_figure(now.arm[None], height)
        figure = skeleton_figure(skeleton, height)
        if seen.all():
            return figure
        whole = self._skeleton(self._seen)
        assert whole is not None
        last = skeleton_figure(whole, height)
        return replace(figure, torso_poses=last.torso_poses, head_positions=last.head_positions)

    def _think(self, now: Snapshot) -> None:
        """Move the latent plot's points on, and set the opacity of the states."""
        frames = self._live_latent
        if now.phase != INTERACTING or not np.isfinite(now.log_alpha).all():
            return
        opacity = np.round(OPACITY_FLOOR + OPACITY_RANGE * np.exp(now.log_alpha), 2)
        frames.opacity[:] = opacity
        fresh = now.interaction != self._interaction
        self._interaction = now.interaction
        middle = self._middle
        latents = {
            "human": now.human_latent,
            "prediction": middle + frames.magnification * (now.robot_latent - middle),
        }
        for name, latent in latents.items():
            if np.isfinite(latent).all():
                trace, point = frames.traces[name], frames.projection.points(latent[None])[0]
                trace[:-1] = point if fresh else trace[1:]
                trace[-1] = point

    @property
    def _middle(self) -> Float[np.ndarray, " D"]:
        assert self._rollout is not None
        return self._rollout.inference.robot_state_means.mean(0)


def first_row(figure: Figure) -> Figure:
    """The figure's first frame alone, in arrays that can be written."""
    return replace(figure, **{name: np.array(getattr(figure, name)[:1]) for name in MOVED})


def empty_plot(frames: LatentFrames) -> LatentFrames:
    """The plot of the same states without a trajectory: a trail of what just was is all that live operation draws."""
    nothing = np.zeros((0, 2, 3))
    middle = {"human": frames.ellipsoids["human"][0].mean(0), "prediction": frames.ellipsoids["robot"][0].mean(0)}
    return replace(
        frames,
        traces={name: np.tile(middle.get(name, np.zeros(3)), (TRAIL + 1, 1)) for name in TRACES},
        known={name: name != "truth" for name in TRACES},
        lines=dict.fromkeys(TRACES, nothing),
        opacity=np.full((TRAIL + 1, frames.opacity.shape[1]), OPACITY_FLOOR),
    )
