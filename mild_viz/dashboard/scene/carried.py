"""The object of a handover. Its shape was not recorded: it is drawn as a plain baton below its tracked point."""

from __future__ import annotations

import numpy as np
import viser

from mild_viz.dashboard.scene.labels import NOTE, add_label
from mild_viz.dashboard.scene.palette import Palette
from mild_viz.dashboard.scene.shapes import Mesh, loft
from mild_viz.robot.carried import OBJECT_LENGTH
from mild_viz.rollout import Rollout

ROOT = "/object"

RADIUS = 0.021
"""Of the baton [m]."""

TEXTS = {True: "object, carried", False: "object, as recorded"}
"""By whether the robot holds it."""


class ObjectView:
    """Draws `object_poses`."""

    def __init__(self, server: viser.ViserServer, colors: Palette) -> None:
        self._baton = server.scene.add_mesh_simple(
            f"{ROOT}/baton", *baton(), color=colors.thing, cast_shadow=False, receive_shadow=False, visible=False
        )
        self._text = add_label(server, f"{ROOT}/text", "", NOTE, "bottom-center")
        self._visible = self._text.visible = False
        self._rollout: Rollout | None = None

    def show(self, rollout: Rollout, colors: Palette, visible: bool) -> None:
        """Take over a rollout; without an object, nothing is drawn."""
        self._rollout = rollout
        self._visible = visible and rollout.object_poses is not None
        self._baton.color = colors.thing
        self._baton.visible = self._text.visible = False

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        rollout = self._rollout
        if rollout is None or rollout.object_poses is None or rollout.object_by_robot is None:
            return
        pose = rollout.object_poses[n]
        seen = self._visible and bool(np.isfinite(pose).all())
        self._baton.visible = self._text.visible = seen
        if seen:
            self._baton.wxyz, self._baton.position = pose[:4], pose[4:]
            self._text.position = pose[4:] + [0.0, 0.0, 0.08]
            self._text.text = TEXTS[bool(rollout.object_by_robot[n])]


def baton() -> Mesh:
    """A rod with rounded ends and a thicker head at the tracked point, which is the origin [m]."""
    sections = [(-OBJECT_LENGTH, 0.004), (-OBJECT_LENGTH + 0.006, 0.85 * RADIUS), (-OBJECT_LENGTH + 0.02, RADIUS)]
    sections += [(-0.05, RADIUS), (-0.035, 1.7 * RADIUS), (0.0, 1.9 * RADIUS), (0.02, 1.5 * RADIUS), (0.03, 0.004)]
    z, radius = np.array(sections).T
    zero = np.zeros_like(z)
    return loft(np.stack([z, radius, radius, zero, zero], axis=1))
