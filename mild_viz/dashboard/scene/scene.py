"""The scene of one page: human, robot and latent plot side by side."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
import viser
from jaxtyping import Float

from mild_viz.dashboard.scene import body
from mild_viz.dashboard.scene.compared import ComparedView
from mild_viz.dashboard.scene.compliance import ComplianceFrames, ComplianceView
from mild_viz.dashboard.scene.figure import Figure, make_figure, partner_figure
from mild_viz.dashboard.scene.giver import GiverView
from mild_viz.dashboard.scene.ground import GroundView
from mild_viz.dashboard.scene.handed import HandedView, handed_frames
from mild_viz.dashboard.scene.human import HumanView
from mild_viz.dashboard.scene.latent import LatentFrames, LatentView, latent_frames
from mild_viz.dashboard.scene.layout import CAMERAS, WIDEST, Camera, Layout, camera, make_layout
from mild_viz.dashboard.scene.palette import palette
from mild_viz.dashboard.scene.reach import ReachView
from mild_viz.dashboard.scene.robot import RobotView, robot_frames
from mild_viz.dashboard.scene.volume import VolumeView
from mild_viz.dashboard.view import ViewSettings
from mild_viz.robot.contact import in_frame
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Rollout

__all__ = ["CAMERAS", "Scene", "fill_initial_camera"]


class Scene:
    """Draws rollouts on one viser server. `show` and `set_frame` may be called from different threads."""

    def __init__(self, server: viser.ViserServer, robot: RobotModel, dark: bool) -> None:
        self._server = server
        self._lock = threading.Lock()
        self._rollout: Rollout | None = None
        self._view: ViewSettings | None = None
        self._figure: Figure | None = None
        self._latent_frames: LatentFrames | None = None
        self._layout: Layout | None = None
        self._frame = 0
        self._presets: dict[int, tuple[str, Camera]] = {}
        self._ground = GroundView(server)
        colors = palette(dark)
        self._human = HumanView(server, colors)
        self._giver = GiverView(server)
        self._giver_figure: Figure | None = None
        self._handed = HandedView(server)
        self._make_robot_views(robot)
        self._latent = LatentView(server, colors)
        self._reach = ReachView(server)

    def _make_robot_views(self, robot: RobotModel) -> None:
        self._robot_model = robot
        self._robot = RobotView(self._server, robot.visuals, robot.link_names, robot.title)
        self._compared = ComparedView(self._server, robot.visuals, robot.link_names)
        self._volume = VolumeView(self._server, robot.chain)
        self._compliance = ComplianceView(self._server, robot.visuals, robot.link_names)

    def set_robot(self, robot: RobotModel) -> None:
        """Draw another robot from the next `show` on; the same one changes nothing."""
        if robot is self._robot_model:
            return
        _ = robot.visuals  # a mesh that cannot be read must not leave the scene without a robot
        with self._lock, self._server.atomic():
            self._rollout = None  # it has poses of other links
            for view in (self._robot, self._compared, self._volume, self._compliance):
                view.remove()
            self._make_robot_views(robot)

    @property
    def layout(self) -> Layout | None:
        """Where the groups of the rollout stand; None before the first `show`."""
        return self._layout

    def show(self, rollout: Rollout, view: ViewSettings, compared: Sequence[Rollout] = ()) -> None:
        """Take over a rollout and a view, and stay at the frame that was shown; `compared` are drawn as ghosts.

        What the new rollout shares with the last one is not computed again: a control-only rerun keeps the
        figure and the latent plot.
        """
        inference = rollout.inference
        last = self._rollout.inference if self._rollout is not None else None
        figure, frames = self._figure, self._latent_frames
        if figure is None or inference is not last:
            figure = make_figure(inference)
        if frames is None or inference is not last or latent_view(view) != latent_view(self._view):
            frames = latent_frames(inference, view)
        giver = partner_figure(inference) if inference is not last else self._giver_figure
        handed = handed_frames(rollout, view.show_robot)
        arms = robot_frames(rollout)
        bounds = self._robot.bounds(rollout)
        layout = scene_layout(rollout, figure, bounds)
        colors = palette(view.dark)
        with self._lock, self._server.atomic():
            self._ground.show(layout.floor, bounds, colors, view.show_robot)
            if self._layout is None:
                fill_initial_camera(self._server, camera("both", layout))
            self._rollout, self._view, self._layout = rollout, view, layout
            self._human.show(figure, rollout.T_world_human, layout.floor, colors, view.show_human, inference.tracked)
            self._compliance.clear()
            # of too many arms none can be told apart
            ghost = view.ghost and not compared and view.compliance is None
            self._robot.show(arms, layout.robot_title, rollout.controller, colors, view.show_robot, ghost)
            self._compared.show([one for one in compared if one.controller != rollout.controller], view.show_robot)
            self._volume.show(colors, view.show_reach and view.show_robot)
            self._reach.show(rollout, colors, view.show_human and view.show_robot)
            self._latent.show(frames, layout, colors, view.show_latent)
            self._giver.show(giver, rollout, layout.floor, colors, view.show_giver)
            self._handed.show(handed, inference.time, colors)
            self._figure, self._giver_figure, self._latent_frames = figure, giver, frames
            self._set_frame(min(self._frame, inference.n_windows - 1))

    def show_compliance(self, frames: ComplianceFrames) -> None:
        """Also draw a simulation of the rollout that is shown, until the next `show`; the solid arm is its command."""
        with self._lock, self._server.atomic():
            if self._rollout is not None and self._view is not None and len(frames.texts) == len(self._rollout.contact):
                self._compliance.show(frames, self._view.show_robot)
                self._robot.show_command(frames.command_poses, frames.caption)
                self._set_frame(self._frame)

    def set_frame(self, n: int) -> None:
        """Show frame n; one beyond the end shows the last."""
        with self._lock:
            if self._rollout is not None:
                with self._server.atomic():
                    self._set_frame(min(max(n, 0), self._rollout.inference.n_windows - 1))

    def camera(self, name: str, aspect: float = WIDEST, headroom: float = 0.0) -> Camera:
        """One of `CAMERAS` for the present layout."""
        assert self._layout is not None, "show() comes first"
        return camera(name, self._layout, aspect, headroom)

    def move_camera(self, client: viser.ClientHandle, name: str) -> None:
        """Take one client's camera to a preset, fitted to that client's canvas."""
        view = self.camera(name, canvas_aspect(client))
        self._presets[client.client_id] = name, view
        with client.atomic():
            client.camera.position = view.position
            client.camera.look_at = view.look_at
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.fov = view.fov

    def refit_cameras(self) -> None:
        """Fit each client's last preset ('both' at first) to the present layout and canvas.

        A camera that a person has moved since stays where it is.
        """
        if self._layout is None:
            return
        clients = self._server.get_clients()
        for client_id in set(self._presets) - set(clients):
            self._presets.pop(client_id, None)
        for client_id, client in clients.items():
            name, last = self._presets.get(client_id, ("both", None))
            if last is None or (is_at(client, last) and is_elsewhere(self.camera(name, canvas_aspect(client)), last)):
                self.move_camera(client, name)

    def _set_frame(self, n: int) -> None:
        self._frame = n
        self._human.set_frame(n)
        self._giver.set_frame(n)
        self._handed.set_frame(n)
        self._robot.set_frame(n)
        self._compliance.set_frame(n)
        self._compared.set_frame(n)
        self._reach.set_frame(n)
        self._latent.set_frame(n)


def fill_initial_camera(server: viser.ViserServer, view: Camera) -> None:
    """Where new browsers start, and where 'Reset view' returns to."""
    initial = server.initial_camera
    initial.position, initial.look_at = view.position, view.look_at
    initial.up, initial.fov = (0.0, 0.0, 1.0), view.fov


def canvas_aspect(client: viser.ClientHandle) -> float:
    """Width over height of a client's canvas."""
    return client.camera.image_width / max(client.camera.image_height, 1)


def is_at(client: viser.ClientHandle, view: Camera) -> bool:
    """Whether a client's camera still is where it was put."""
    camera = client.camera
    now, then = np.array([camera.position, camera.look_at]), np.array([view.position, view.look_at])
    return bool(np.abs(now - then).max() < 0.02)


def is_elsewhere(view: Camera, last: Camera) -> bool:
    """Whether two cameras differ by more than a hundredth of the distance to what they look at."""
    here, there = np.array([view.position, view.look_at]), np.array([last.position, last.look_at])
    step = float(np.linalg.norm(here - there, axis=1).max())
    return step > 0.01 * float(np.linalg.norm(there[0] - there[1])) or abs(view.fov - last.fov) > 0.01


def latent_view(view: ViewSettings | None) -> tuple[object, ...]:
    """The part of the view that the latent arrays depend on."""
    return () if view is None else (view.alpha_mode, view.latent_axes, view.sigma)


def scene_layout(rollout: Rollout, figure: Figure, bounds: Float[np.ndarray, "2 3"]) -> Layout:
    """The layout of a rollout: the human stands on the floor, the robot on it too or on a pedestal."""
    T = rollout.T_world_human
    up = T[:3, :3].T @ [0.0, 0.0, 1.0]
    middle, height = figure.shoulders, figure.height
    distance = np.where(np.isfinite(rollout.hand_distance), rollout.hand_distance, np.inf)
    nearest = int(distance.argmin())
    crown, eye, sole = (
        T[:3, :3] @ point + T[:3, 3]
        for point in (
            figure.crown, figure.crowns[nearest] - 0.07 * height * up, middle - body.COLLAR_SHARE * height * up
        )
    )  # fmt: skip
    feet = float(sole[2]) if figure.soles is None else float((T[:3, :3] @ figure.soles + T[:3, 3])[2])
    hand = np.nan_to_num(rollout.target[nearest])
    arm_top = float(np.median(rollout.link_poses[:, :, 6].max(axis=1)))  # an arm without a body stands above its base
    robot_top = np.array([0.0, 0.0, max(bounds[1, 2], arm_top)])
    walk = in_frame(T, figure.crowns[:: max(1, len(figure.crowns) // 16)]) if figure.walks else crown[None]
    return make_layout(robot_top, crown, eye, hand, min(float(bounds[0, 2]), feet), walk)
