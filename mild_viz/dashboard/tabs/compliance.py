"""How the arm gives way to the human's hand: whether it is simulated, what is drawn of it, and the comparison."""

from __future__ import annotations

from html import escape

import viser

from mild_viz.dashboard.scene.palette import FORCE, SIMULATED
from mild_viz.dashboard.tabs.widgets import Changed, on_person, option, set_content
from mild_viz.dashboard.view import ComplianceSettings
from mild_viz.simulation.compare import Comparison

SHAKING = {"robot as commanded": "commanded", "human alone": "human-led"}
"""How the scenarios are called on the page."""

STIFFNESS = {"schedule": "schedule", "full": "fixed"}

NOTE = (
    "Masses and stiffnesses are estimates (README): compare the columns with each other. Hands: how far the robot's "
    "is pushed from its command, and the human's held back from where it was recorded."
)


class ComplianceTab:
    """Widgets of `ComplianceSettings`, and the table."""

    def __init__(self, gui: viser.GuiApi, changed: Changed) -> None:
        self._on = gui.add_checkbox(
            "Simulate", False, hint="Simulate how the arm gives way to the human's hand (MuJoCo)."
        )
        self._scenario = gui.add_dropdown(
            "Shaking by", tuple(SHAKING), visible=False,
            hint="The robot moves as commanded; or its command stands still while the hands hold each other.",
        )  # fmt: skip
        self._stiffness = gui.add_dropdown(
            "Stiffness", tuple(STIFFNESS), visible=False,
            hint="Which arm is drawn: lowered stiffness in contact, or full stiffness throughout.",
        )  # fmt: skip
        self._text = gui.add_html("", visible=False)
        for handle in (self._on, self._scenario, self._stiffness):
            on_person(handle, changed)

    def read(self) -> ComplianceSettings | None:
        """What is to be shown; None where nothing is simulated."""
        on = bool(self._on.value)
        for handle in (self._scenario, self._stiffness):
            if handle.visible != on:
                handle.visible = on
        if not on:
            return None
        return ComplianceSettings(SHAKING[option(self._scenario)], STIFFNESS[option(self._stiffness)])

    def say(self, text: str) -> None:
        """A sentence in place of the table; none for an empty one."""
        self._text.visible = bool(text)
        set_content(self._text, f'<div class="mv-note" role="status">{escape(text)}</div>')

    def show(self, comparison: Comparison) -> None:
        """Write the comparison."""
        self._text.visible = True
        set_content(self._text, table_html(comparison))


def table_html(comparison: Comparison) -> str:
    """Full stiffness beside the schedule."""
    if not comparison.grips:
        return '<div class="mv-note">The hands never hold each other in this trial: there is no contact.</div>'
    fixed, schedule = (comparison.motions[name].summary() for name in ("fixed", "schedule"))
    lines = (
        ("Force, peak [N]", fixed.force_peak, schedule.force_peak, 1.0),
        ("Force, rms [N]", fixed.force_rms, schedule.force_rms, 1.0),
        ("Robot's hand, peak [cm]", fixed.displacement_peak, schedule.displacement_peak, 100.0),
        ("Human's hand, peak [cm]", fixed.human_displacement_peak, schedule.human_displacement_peak, 100.0),
    )
    rows = "".join(
        f"<tr><th>{name}</th><td>{scale * full:.1f}</td><td><b>{scale * soft:.1f}</b></td></tr>"
        for name, full, soft, scale in lines
    )
    swatches = "".join(
        f'<span class="mv-swatch" style="background:rgb{color};margin-left:8px"></span>{name}'
        for color, name in ((SIMULATED, "simulated arm"), (FORCE, "force on the robot's hand"))
    )
    same = "" if comparison.scheduled else " This controller never lowers the stiffness here: both are the same."
    return (
        f'<table class="mv-table"><tr><th></th><th>full<br>stiffness</th><th>schedule</th></tr>{rows}</table>'
        f'<div class="mv-note">{swatches}<br>{NOTE}{same}</div>'
    )
