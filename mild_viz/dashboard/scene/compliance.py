"""How the arm gives way: the simulated arm as a ghost, and the force between the hands as an arrow with its value."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
import viser
from jaxtyping import Float

from mild_viz.dashboard.scene.ghost import GhostArm, moving_links
from mild_viz.dashboard.scene.labels import NOTE, add_label
from mild_viz.dashboard.scene.palette import FORCE, SIMULATED, linear
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Rollout
from mild_viz.simulation.compare import Comparison

ROOT = "/compliance"

OPACITY = 0.6

METRES_PER_NEWTON = 0.008
"""Length of the arrow: a hand's breadth for 10 N."""

ARROW_ABOVE = 0.1
"""Of the hand [m]: at the hand itself the human's arm, which pulls along itself, would hide the arrow."""

TEXT_BELOW = 0.22
"""Of the hand [m]: under the line that tells the distance between the hands."""

SHORTEST = 0.3
"""Weaker forces [N] have no arrow: it would be a dot."""


@dataclass(frozen=True, eq=False)
class ComplianceFrames:
    """What is drawn of one simulation."""

    poses: Float[np.ndarray, "N L 7"]
    """Of every link of the simulated robot."""
    command_poses: Float[np.ndarray, "N L 7"]
    """Of every link as commanded in the simulation."""
    hand: Float[np.ndarray, "N 3"]
    """The simulated hand, world [m]."""
    force: Float[np.ndarray, "N 3"]
    """[N]"""
    caption: str
    """Of the robot: what is solid, what is pale."""
    texts: list[str]
    """Force and displacement in words; empty without a grip."""


def compliance_frames(robot: RobotModel, rollout: Rollout, comparison: Comparison, stiffness: str) -> ComplianceFrames:
    """Poses of one of the two motions of a comparison."""
    motion, action = comparison.motions[stiffness], rollout.inference.action
    held = comparison.scenario != "commanded"
    texts = [
        f"{force:.1f} N · gives way {100.0 * way:.1f} cm" if gripped else ""
        for force, way, gripped in zip(
            motion.force.tolist(), motion.displacement.tolist(), motion.gripped.tolist(), strict=True
        )
    ]
    return ComplianceFrames(
        robot.link_poses(motion.joints, action),
        robot.link_poses(comparison.joints_commanded, action) if held else rollout.link_poses,
        motion.end_effector,
        motion.hand_force,
        f"{rollout.controller} command{', held in the grip' if held else ''} · cyan: simulated",
        texts,
    )


class ComplianceView:
    """One translucent arm, added when it is first asked for, an arrow and a text."""

    def __init__(
        self, server: viser.ViserServer, visuals: dict[str, trimesh.Trimesh], link_names: tuple[str, ...]
    ) -> None:
        self._frame = server.scene.add_frame(ROOT, show_axes=False, visible=False)
        self._arm = GhostArm(server, f"{ROOT}/arm", visuals, link_names, OPACITY)
        self._arrow = server.scene.add_arrows(
            f"{ROOT}/force", np.zeros((1, 2, 3)), linear(np.array(FORCE, dtype=np.uint8)), shaft_radius=0.008,
            head_radius=0.018, head_length=0.03,
        )  # fmt: skip
        self._text = add_label(server, f"{ROOT}/text", "", NOTE, "top-center")
        self._frames: ComplianceFrames | None = None

    def clear(self) -> None:
        """Draw nothing: what was simulated no longer belongs to what is shown."""
        self._frames = None
        self._frame.visible = self._arm.visible = False

    def show(self, frames: ComplianceFrames, visible: bool) -> None:
        """Take over a simulation."""
        self._frames, self._frame.visible, self._arm.visible = frames, visible, visible
        self._arm.show(frames.poses, moving_links(frames.poses), SIMULATED)

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        frames = self._frames
        if frames is None or not self._frame.visible:
            return
        self._arm.set_frame(n)
        hand, force = frames.hand[n], frames.force[n]
        pulls = bool(np.linalg.norm(force) >= SHORTEST)
        self._arrow.visible, self._text.visible = pulls, bool(frames.texts[n])
        if pulls:
            foot = hand + [0.0, 0.0, ARROW_ABOVE]
            self._arrow.points = np.stack([foot, foot + METRES_PER_NEWTON * force])[None].astype(np.float32)
        if frames.texts[n]:
            self._text.text = frames.texts[n]
            self._text.position = hand - [0.0, 0.0, TEXT_BELOW]

    def remove(self) -> None:
        """Take everything out of the scene."""
        for handle in (self._arm, self._arrow, self._text, self._frame):
            handle.remove()
