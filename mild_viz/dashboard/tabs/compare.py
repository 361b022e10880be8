"""Up to three controllers beside each other: which are drawn as coloured ghosts, and the table of how they do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser

from mild_viz.dashboard.scene.palette import CONTROLLER_COLORS
from mild_viz.dashboard.tabs.widgets import Changed, on_person, set_content
from mild_viz.evaluation.controllers import ControllerFigures

NOTE = (
    "Distance between the hands and cost of the inverse kinematics over the frames in a contact state; smallest "
    "distance of a joint from its limits over the trial. Everything else as set above."
)


class CompareFolder:
    """One checkbox per controller, and the table."""

    def __init__(self, gui: viser.GuiApi, changed: Changed) -> None:
        with gui.add_folder("Compare controllers"):
            self._boxes = {
                name: gui.add_checkbox(name, False, hint=f"Also run {name} on this trial, and draw its arm as a ghost.")
                for name in CONTROLLER_COLORS
            }
            self._table = gui.add_html("", visible=False)
        for box in self._boxes.values():
            on_person(box, changed)

    def read(self, valid: Sequence[str]) -> tuple[str, ...]:
        """The ticked controllers, of those that go with the model."""
        for name, box in self._boxes.items():
            if box.disabled != (name not in valid):
                box.disabled = name not in valid
        return tuple(name for name, box in self._boxes.items() if box.value and name in valid)

    def show(self, figures: Sequence[ControllerFigures]) -> None:
        """Write the table of the controllers that were run; nothing where there is none."""
        self._table.visible = bool(figures)
        if figures:
            set_content(self._table, table_html(figures))


def table_html(figures: Sequence[ControllerFigures]) -> str:
    """The table: one row per controller, the best figure of each column in bold."""
    columns = (
        ("mean<br>[cm]", [100.0 * one.mean_distance for one in figures], "{:.1f}", min),
        ("least<br>[cm]", [100.0 * one.smallest_distance for one in figures], "{:.1f}", min),
        ("IK cost<br>×10⁻³", [1e3 * one.ik_cost for one in figures], "{:.2f}", min),
        ("limits<br>[°]", [float(np.degrees(one.limit_margin)) for one in figures], "{:.1f}", max),
    )
    head = "".join(f"<th>{name}</th>" for name, *_ in columns)
    rows = []
    for i, one in enumerate(figures):
        cells = []
        for _, values, form, best in columns:
            text = form.format(values[i]) if np.isfinite(values[i]) else "–"
            texts = [form.format(value) for value in values if np.isfinite(value)]
            first = len(figures) > 1 and bool(texts) and text == form.format(best(v for v in values if np.isfinite(v)))
            cells.append(f"<td>{f'<b>{text}</b>' if first else text}</td>")
        red, green, blue = CONTROLLER_COLORS[one.controller]
        swatch = f'<span class="mv-swatch" style="background:rgb({red},{green},{blue})"></span>'
        rows.append(f"<tr><th>{swatch}{one.controller}</th>{''.join(cells)}</tr>")
    return f'<table class="mv-table"><tr><th></th>{head}</tr>{"".join(rows)}</table><div class="mv-note">{NOTE}</div>'
