"""A translucent arm: the links that move in a track of poses, each added to the scene when it is first needed."""

from __future__ import annotations

import numpy as np
import trimesh
import viser
from jaxtyping import Float

from mild_viz.dashboard.scene.palette import Rgb


def moving_links(poses: Float[np.ndarray, "N L 7"]) -> tuple[int, ...]:
    """Indices of the links that do not stand still."""
    return tuple(np.flatnonzero((np.ptp(poses, axis=0) > 1e-6).any(1)).tolist())


class GhostArm:
    """One track of link poses. It is posed only while it is visible."""

    def __init__(
        self,
        server: viser.ViserServer,
        root: str,
        visuals: dict[str, trimesh.Trimesh],
        link_names: tuple[str, ...],
        opacity: float,
    ) -> None:
        self._server, self._root, self._opacity = server, root, opacity
        self._visuals, self._link_names = visuals, link_names
        self._frame = server.scene.add_frame(root, show_axes=False, visible=False)
        self._links: dict[int, viser.MeshHandle] = {}
        self._poses: Float[np.ndarray, "N L 7"] | None = None
        self._moving: tuple[int, ...] = ()

    @property
    def visible(self) -> bool:
        return self._frame.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._frame.visible = visible

    def show(self, poses: Float[np.ndarray, "N L 7"], moving: tuple[int, ...], color: Rgb) -> None:
        """Take over a track, of which the links `moving` are drawn."""
        self._poses = poses
        self._moving = tuple(i for i in moving if self._link_names[i] in self._visuals)
        for i in set(self._moving) - set(self._links):
            link = self._link_names[i]
            mesh = self._visuals[link]
            self._links[i] = self._server.scene.add_mesh_simple(
                f"{self._root}/{link}", mesh.vertices, mesh.faces, opacity=self._opacity,
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        for i, handle in self._links.items():
            handle.color = color
            handle.visible = i in self._moving

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        if self._poses is not None and self.visible:
            for i in self._moving:
                handle, pose = self._links[i], self._poses[n, i]
                handle.wxyz, handle.position = pose[:4], pose[4:]

    def remove(self) -> None:
        """Take everything out of the scene."""
        for handle in (*self._links.values(), self._frame):
            handle.remove()
