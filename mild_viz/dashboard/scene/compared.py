"""Controllers compared: the arm of each as a ghost in its own colour."""

from __future__ import annotations

from collections.abc import Sequence

import trimesh
import viser

from mild_viz.dashboard.scene.palette import CONTROLLER_COLORS
from mild_viz.dashboard.scene.robot import moving_links
from mild_viz.rollout import Rollout

ROOT = "/compared"

OPACITY = 0.55


class ComparedView:
    """One translucent arm per controller; its links are added when it is first asked for."""

    def __init__(
        self, server: viser.ViserServer, visuals: dict[str, trimesh.Trimesh], link_names: tuple[str, ...]
    ) -> None:
        self._server, self._visuals, self._link_names = server, visuals, link_names
        self._frames = {name: server.scene.add_frame(f"{ROOT}/{name}", show_axes=False) for name in CONTROLLER_COLORS}
        self._links: dict[tuple[str, int], viser.MeshHandle] = {}
        self._shown: dict[str, tuple[Rollout, tuple[int, ...]]] = {}

    def show(self, rollouts: Sequence[Rollout], visible: bool) -> None:
        """Take over one rollout per controller that is compared; none hides all."""
        self._shown = {}
        for rollout in rollouts:
            links = tuple(i for i in moving_links(rollout.link_poses) if self._link_names[i] in self._visuals)
            self._shown[rollout.controller] = rollout, links
            for i in links:
                self._add(rollout.controller, i)
        for name, frame in self._frames.items():
            frame.visible = visible and name in self._shown
        for (name, i), handle in self._links.items():
            handle.visible = name in self._shown and i in self._shown[name][1]

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        for name, (rollout, links) in self._shown.items():
            for i in links:
                handle, pose = self._links[name, i], rollout.link_poses[n, i]
                handle.wxyz, handle.position = pose[:4], pose[4:]

    def remove(self) -> None:
        """Take everything out of the scene."""
        for handle in (*self._links.values(), *self._frames.values()):
            handle.remove()

    def _add(self, name: str, i: int) -> None:
        if (name, i) not in self._links:
            link = self._link_names[i]
            mesh = self._visuals[link]
            self._links[name, i] = self._server.scene.add_mesh_simple(
                f"{ROOT}/{name}/{link}", mesh.vertices, mesh.faces, color=CONTROLLER_COLORS[name], opacity=OPACITY,
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
