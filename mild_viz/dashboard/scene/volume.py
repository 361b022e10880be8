"""Where the robot's hand can be: a translucent surface around the arm's shoulder."""

from __future__ import annotations

import numpy as np
import viser

from mild_viz.dashboard.scene.palette import Palette
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.reach import reach_volume

ROOT = "/reach_volume"

OPACITY = 0.12


class VolumeView:
    """The reach of the interacting arm, computed when it is first asked for."""

    def __init__(self, server: viser.ViserServer, chain: ArmChain) -> None:
        self._server, self._chain = server, chain
        self._surface: viser.MeshHandle | None = None

    def remove(self) -> None:
        """Take it out of the scene."""
        if self._surface is not None:
            self._surface.remove()
            self._surface = None

    def show(self, colors: Palette, visible: bool) -> None:
        """Draw it or not."""
        if visible and self._surface is None:
            volume = reach_volume(self._chain)
            self._surface = self._server.scene.add_mesh_simple(
                ROOT, np.array(volume.vertices), np.array(volume.faces), opacity=OPACITY, side="double",
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        if self._surface is not None:
            self._surface.visible = visible
            self._surface.color = colors.robot
