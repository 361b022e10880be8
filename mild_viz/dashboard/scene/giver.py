"""The recorded giver of a handover: a faint figure in the robot's place, to compare the robot with."""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Float

from mild_viz.dashboard.scene import body
from mild_viz.dashboard.scene.figure import Figure
from mild_viz.dashboard.scene.human import add_observed, pose_observed, support
from mild_viz.dashboard.scene.labels import NOTE, add_label
from mild_viz.dashboard.scene.palette import Palette, linear
from mild_viz.dashboard.scene.shapes import quaternion_from_matrix
from mild_viz.rollout import Rollout

ROOT = "/giver"

OPACITY = 0.3

SHORTEST = 0.4
"""Legs are drawn down to the receiver's floor from this share of their natural length on: both persons were tracked
in one world, but some 15 cm apart in height."""


class GiverView:
    """One colourless, translucent person; nodes are added when a recording first has a giver."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._frame = server.scene.add_frame(ROOT, show_axes=False)
        self._label = add_label(server, f"{ROOT}/label", "grey: recorded giver", NOTE, "center-right")
        self._frame.visible = False
        self._figure: Figure | None = None
        self._legs: viser.MeshHandle | None = None
        self._visible = False

    def show(self, figure: Figure | None, rollout: Rollout, floor: float, colors: Palette, visible: bool) -> None:
        """Take over the giver of a rollout; None hides the view."""
        T_world_giver = rollout.T_world_partner
        self._visible = visible and figure is not None and T_world_giver is not None
        self._frame.visible = self._visible
        if not self._visible:
            return
        assert figure is not None and T_world_giver is not None
        if self._figure is not figure:
            self._replace(figure)
        self._frame.position = T_world_giver[:3, 3]
        self._frame.wxyz = quaternion_from_matrix(T_world_giver[None, :3, :3])[0]
        for part in (self._limbs, self._balls):
            part.batched_colors = linear(np.array(colors.schematic, dtype=np.uint8))
        self._stand(figure, T_world_giver, floor)
        for part in (self._torso, self._head, self._legs):
            if part is not None:
                part.color = colors.schematic
        # Behind the thighs, where neither the robot nor anything that is written about the hands is.
        self._label.position = figure.shoulders - [0.22, 0.0, 0.45 * figure.height]

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        figure = self._figure
        if figure is None or not self._visible:
            return
        pose_observed(self._limbs, self._balls, figure, n)
        self._torso.wxyz = self._head.wxyz = figure.torso_poses[n, :4]
        self._torso.position, self._head.position = figure.torso_poses[n, 4:], figure.head_positions[n]

    def _stand(self, figure: Figure, T_world_giver: Float[np.ndarray, "4 4"], floor: float) -> None:
        """Schematic legs, down to the floor."""
        if self._legs is not None:
            self._legs.remove()
        mesh = support(figure, T_world_giver, floor, SHORTEST)
        self._legs = mesh and self._server.scene.add_mesh_simple(
            f"{ROOT}/legs", *mesh, opacity=OPACITY, cast_shadow=False, receive_shadow=False
        )

    def _replace(self, figure: Figure) -> None:
        if self._figure is not None:
            for part in (self._limbs, self._balls, self._torso, self._head):
                part.remove()
        self._figure = figure
        self._limbs, self._balls = add_observed(self._server, ROOT, figure, OPACITY)
        self._torso, self._head = (
            self._server.scene.add_mesh_simple(
                f"{ROOT}/{name}", *mesh, opacity=OPACITY, cast_shadow=False, receive_shadow=False
            )
            for name, mesh in (("torso", body.torso(figure.height)), ("head", body.head(figure.height)))
        )
