"""The gap between the robot's hand and the human's: a line with its length, where they touch, and the target."""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Bool, Float

from mild_viz.dashboard.scene.labels import NOTE, add_label
from mild_viz.dashboard.scene.palette import Palette
from mild_viz.robot.control.rules import OUT_OF_REACH
from mild_viz.rollout import Rollout

ROOT = "/reach"

TOUCH = 0.05
"""A contact state is a phase of the interaction, not a measured touch: nearer than this [m] hands are marked."""


class ReachView:
    """Draws `hand_distance` where it is."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._frame = server.scene.add_frame(ROOT, show_axes=False)
        self._line = server.scene.add_line_segments(
            f"{ROOT}/line", np.zeros((1, 2, 3)), (0, 0, 0), thickness=3.0, thickness_units="screen"
        )
        self._contact = server.scene.add_icosphere(
            f"{ROOT}/contact", radius=0.085, opacity=0.3, cast_shadow=False, receive_shadow=False
        )
        self._target = server.scene.add_icosphere(
            f"{ROOT}/target", radius=0.06, subdivisions=1, wireframe=True, opacity=0.4,
            cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        self._text = add_label(server, f"{ROOT}/distance", "", NOTE, "top-center")
        self._rollout: Rollout | None = None

    def show(self, rollout: Rollout, colors: Palette, visible: bool) -> None:
        """Take over a rollout."""
        self._rollout = rollout
        self._frame.visible = visible
        self._ends = np.nan_to_num(np.stack([rollout.end_effector, rollout.target], axis=1))
        self._texts = distance_texts(rollout)
        self._label_positions = np.nan_to_num(label_positions(rollout))
        self._unreachable = out_of_reach(rollout)
        self._aimed = np.isfinite(rollout.target.sum(axis=1))
        self._target_colors = {True: colors.unreachable, False: colors.distance}
        self._known = np.isfinite(rollout.hand_distance) & rollout.inference.tracked
        # One colour for the whole line, from its creation on: the browser does not recompile a line whose colours
        # change from one to many.
        self._colors = {
            contact: np.array(color, dtype=np.uint8)
            for contact, color in ((True, colors.contact), (False, colors.distance))
        }
        self._contact.color = colors.contact

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        if self._rollout is None:
            return
        known, contact = bool(self._known[n]), bool(self._rollout.contact[n])
        self._line.visible = self._text.visible = known
        # where the controller believes the hand to be: while tracking is lost, where it was seen last
        self._contact.visible = known and contact and bool(self._rollout.hand_distance[n] < TOUCH)
        self._target.visible = bool(self._aimed[n]) and not self._contact.visible  # one mark at a time
        self._target.position = self._ends[n, 1]
        self._target.color = self._target_colors[bool(self._unreachable[n])]
        if not known:
            return
        self._line.points = self._ends[n : n + 1]
        self._line.colors = self._colors[contact]
        self._contact.position = self._ends[n].mean(0)
        self._text.text = self._texts[n]
        self._text.position = self._label_positions[n]


def distance_texts(rollout: Rollout) -> list[str]:
    """What is written at the line in every frame."""
    return [
        f"{100.0 * distance:.1f} cm" + (" · contact state" if contact else "") + (" · out of reach" if far else "")
        for distance, contact, far in zip(
            rollout.hand_distance.tolist(), rollout.contact.tolist(), out_of_reach(rollout).tolist(), strict=True
        )
    ]


def out_of_reach(rollout: Rollout) -> Bool[np.ndarray, " N"]:
    """Where the controller wanted the hand and could not get there: the rule of that name."""
    return (rollout.fired >> OUT_OF_REACH & 1).astype(bool)


def label_positions(rollout: Rollout) -> Float[np.ndarray, "N 3"]:
    """Below both hands, so that the text hides neither."""
    middle = 0.5 * (rollout.end_effector + rollout.target)
    middle[:, 2] = np.minimum(rollout.end_effector[:, 2], rollout.target[:, 2]) - 0.12
    return middle
