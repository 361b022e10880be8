"""Controllers compared: the arm of each as a ghost in its own colour."""

from __future__ import annotations

from collections.abc import Sequence

import trimesh
import viser

from mild_viz.dashboard.scene.ghost import GhostArm, moving_links
from mild_viz.dashboard.scene.palette import CONTROLLER_COLORS
from mild_viz.rollout import Rollout

ROOT = "/compared"

OPACITY = 0.55


class ComparedView:
    """One translucent arm per controller."""

    def __init__(
        self, server: viser.ViserServer, visuals: dict[str, trimesh.Trimesh], link_names: tuple[str, ...]
    ) -> None:
        self._arms = {
            name: GhostArm(server, f"{ROOT}/{name}", visuals, link_names, OPACITY) for name in CONTROLLER_COLORS
        }

    def show(self, rollouts: Sequence[Rollout], visible: bool) -> None:
        """Take over one rollout per controller that is compared; none hides all."""
        shown = {rollout.controller: rollout for rollout in rollouts}
        for name, arm in self._arms.items():
            arm.visible = visible and name in shown
            if name in shown:
                poses = shown[name].link_poses
                arm.show(poses, moving_links(poses), CONTROLLER_COLORS[name])

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        for arm in self._arms.values():
            arm.set_frame(n)

    def remove(self) -> None:
        """Take everything out of the scene."""
        for arm in self._arms.values():
            arm.remove()
