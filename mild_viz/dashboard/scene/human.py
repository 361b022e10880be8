"""The human: what was observed is solid, what was not is a faint schematic person; and the recorded giver."""

from __future__ import annotations

import numpy as np
import viser
from jaxtyping import Bool, Float

from mild_viz.dashboard.scene.figure import Figure
from mild_viz.dashboard.scene.labels import NOTE, add_label, add_title
from mild_viz.dashboard.scene.palette import Palette
from mild_viz.dashboard.scene.person import PersonView

ROOT, GIVER_ROOT = "/human", "/giver"


class HumanView:
    """The human with the title, which goes along with somebody who walks."""

    def __init__(self, server: viser.ViserServer, colors: Palette) -> None:
        self._person = PersonView(server, ROOT, colors)
        self._title, self._caption = add_title(server, ROOT, "Human")
        self._lost = add_label(server, f"{ROOT}/lost", "tracking lost", NOTE, "center-center")
        self._figure: Figure | None = None

    def show(
        self,
        figure: Figure,
        T_world_human: Float[np.ndarray, "4 4"],
        floor: float,
        colors: Palette,
        visible: bool,
        tracked: Bool[np.ndarray, " N"],
    ) -> None:
        """Take over a figure."""
        self._tracked = tracked
        self._person.show(figure, T_world_human, floor, colors, visible)
        if figure is not self._figure:
            self._figure = figure
            self._place_labels(figure, np.zeros(3))
            whole = "red arm: model input" if figure.soles is not None else "red arm: model input, pale: schematic"
            self._caption.text = whole if figure.whole else "right arm observed, rest schematic"

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        figure = self._figure
        if figure is None:
            return
        self._person.set_frame(n)
        self._lost.visible = not bool(self._tracked[n])
        if figure.walks:
            self._place_labels(figure, figure.steps[n])

    def _place_labels(self, figure: Figure, step: Float[np.ndarray, " 3"]) -> None:
        self._title.position = self._caption.position = figure.crown + step + [0.0, 0.0, 0.13]
        self._lost.position = figure.shoulders + step + [0.0, 0.0, -0.14 * figure.height]


class GiverView:
    """The person whose place the robot takes in a handover, as recorded: faint."""

    def __init__(self, server: viser.ViserServer, colors: Palette) -> None:
        self._person = PersonView(server, GIVER_ROOT, colors, faint=True)

    def show(
        self,
        figure: Figure | None,
        T_world_human: Float[np.ndarray, "4 4"],
        floor: float,
        colors: Palette,
        visible: bool,
    ) -> None:
        """Take over a figure in the human's frame; None without a giver."""
        if figure is None or not visible:
            self._person.hide()
        else:
            self._person.show(figure, T_world_human, floor, colors, visible)

    def set_frame(self, n: int) -> None:
        """Show frame n."""
        self._person.set_frame(n)
