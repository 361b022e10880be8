"""The control panel: a header that says what is shown, the message of a failed rerun, and the tabs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from html import escape

import numpy as np
import viser

from mild_viz.checkpoint import Checkpoint, save_contact_states
from mild_viz.dashboard.catalog import Catalog
from mild_viz.dashboard.readout import distance_html, rules_text, state_html, stiffness_text
from mild_viz.dashboard.session import Choice
from mild_viz.dashboard.style import PANEL_CSS, PANEL_WIDTH
from mild_viz.dashboard.tabs.compare import CompareFolder
from mild_viz.dashboard.tabs.compliance import ComplianceTab
from mild_viz.dashboard.tabs.record import RecordTab, Writer
from mild_viz.dashboard.tabs.robot import RobotTab
from mild_viz.dashboard.tabs.states import StatesTab
from mild_viz.dashboard.tabs.trial import TrialTab
from mild_viz.dashboard.tabs.view import ViewTab
from mild_viz.dashboard.tabs.widgets import sentence, set_content
from mild_viz.errors import UserError
from mild_viz.evaluation.controllers import ControllerFigures
from mild_viz.rollout import Rollout
from mild_viz.settings import CONTROLLERS_OF, ControlSettings, InferSettings, Settings
from mild_viz.trial import CONTACT_ACTIONS


class Controls:
    """Every widget of the panel. `read` turns them into a `Choice`; `show` follows the rollout."""

    def __init__(
        self,
        server: viser.ViserServer,
        catalog: Catalog,
        first: InferSettings,
        model: str,
        changed: Callable[[], None],
        move_camera: Callable[[viser.ClientHandle, str], None],
        write_html: Writer,
        write_csv: Writer,
        control: ControlSettings,
    ) -> None:
        self._server, self._catalog = server, catalog
        self._rollout: Rollout | None = None
        self._choice: Choice | None = None
        gui = server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        gui.add_html(f"<style>{PANEL_CSS}</style>")
        self._header = gui.add_html('<div class="mv-header">Loading …</div>')
        self._now = gui.add_html("")
        self._error = gui.add_html("", visible=False)
        tabs = gui.add_tab_group()
        with tabs.add_tab("Trial"):
            self._trial = TrialTab(gui, catalog, first, model, changed)
        with tabs.add_tab("Robot"):
            self._robot = RobotTab(gui, changed, control)
            self._compare = CompareFolder(gui, changed)
        with tabs.add_tab("States"):
            self._states = StatesTab(gui, changed)
            self._states.save.on_click(lambda _event: self._save_contact_states())
        with tabs.add_tab("Force"):
            self.compliance = ComplianceTab(gui, changed)
        with tabs.add_tab("View"):
            self._view = ViewTab(gui, changed, move_camera)
        with tabs.add_tab("Record"):
            RecordTab(gui, lambda: self._rollout, lambda: self._model_of(self._choice), write_html, write_csv)

    def read(self) -> Choice:
        """What the widgets say, checked. Raises UserError naming the widget."""
        infer, checkpoint, trial, robot = self._trial.read()
        contact_states = self._states.read(checkpoint, infer.variant, trial.action)
        control = self._robot.read(checkpoint, trial, robot, contact_states)
        view = replace(
            self._view.read(),
            compared=self._compare.read(CONTROLLERS_OF[checkpoint.decodes]),
            compliance=self.compliance.read(),
        )
        return Choice(Settings(infer, control), view, checkpoint, trial, robot)

    def show(self, rollout: Rollout, choice: Choice, compared: Sequence[ControllerFigures] = ()) -> None:
        """Follow a new rollout, and the figures of the controllers that are compared on its trial."""
        self._compare.show(compared)
        self._rollout, self._choice = rollout, choice
        self._view.show(rollout)
        self._trial.show(rollout)
        self._robot.show(rollout)
        self._states.show(rollout)
        self._compare_contact_states(rollout.contact_states, choice)
        set_content(self._header, header_html(rollout, self._model_of(choice)))

    def remember_contact_states(
        self, checkpoint: Checkpoint, variant: str, action: str, states: frozenset[int] | None
    ) -> None:
        """Tick these once this model and action are shown, not the model's own."""
        if states is not None:
            self._states.remember(checkpoint, variant, action, states)

    def offer_datasets(self) -> None:
        """Complete the list of datasets, which takes reading them."""
        self._trial.offer_datasets()

    def tick(self, frame: int) -> None:
        """Write what holds at the time cursor."""
        if self._rollout is not None:
            set_content(self._now, now_html(self._rollout, min(frame, self._rollout.inference.n_windows - 1)))

    def report(self, message: str | None) -> None:
        """Show the message of a failed rerun until the next that succeeds."""
        if message is None:
            self._error.visible = False
            return
        set_content(
            self._error,
            f'<div class="mv-error" role="alert"><b>This could not be done.</b> {escape(sentence(message))} '
            "The last good result is still shown.</div>",
        )
        self._error.visible = True
        for client in self._server.get_clients().values():
            client.add_notification("This could not be done", sentence(message), color="red", auto_close_seconds=8.0)

    def _model_of(self, choice: Choice | None) -> str:
        """The model's name on the page: a copy of a shipped model calls itself as the original does."""
        return "" if choice is None else self._catalog.name_of(choice.checkpoint.path)

    def _compare_contact_states(self, ticked: frozenset[int], choice: Choice) -> None:
        action, variant = choice.trial.action, choice.settings.infer.variant
        stored = self._catalog.current(choice.checkpoint).contact_states_of(variant, action)
        self._states.compare(ticked, stored, action, self._model_of(choice))

    def _save_contact_states(self) -> None:
        choice = self._choice
        if choice is None:
            return
        states = choice.settings.control.contact_states or frozenset()
        action, variant = choice.trial.action, choice.settings.infer.variant
        try:
            current = self._catalog.current(choice.checkpoint)
            self._catalog.replace_checkpoint(save_contact_states(current, variant, action, states))
        except UserError as error:
            self._states.say_saved(f"Not saved: {error}")
            return
        self._compare_contact_states(states, choice)


def header_html(rollout: Rollout, model: str) -> str:
    """What is shown, and how well the model itself (not the controller) predicts this trial."""
    inference = rollout.inference
    errors = inference.window_error[np.isfinite(inference.window_error)]
    mse = f"{errors.mean():.4f} {inference.error_unit}" if len(errors) else "unknown (no true motion)"
    return (
        f'<div class="mv-header"><b>{escape(inference.dataset)} · {escape(inference.action)} · '
        f"{escape(inference.split)} {inference.trial}</b><br>"
        f"model {escape(model)}, controller {escape(rollout.controller)}<br>"
        f"variant {escape(inference.variant)}, MSE of the decoded motion (before IK) <b>{mse}</b></div>"
    )


def now_html(rollout: Rollout, frame: int) -> str:
    """State, stiffness and, where the partners touch, the distance at the cursor."""
    # Where nobody touches, the distance says nothing about how well it goes.
    emphasis = "<b>{}</b>" if rollout.inference.action in CONTACT_ACTIONS else "{}"
    return (
        f'<div class="mv-header mv-live">{state_html(rollout, frame)} · {stiffness_text(rollout, frame)}<br>'
        f"{distance_html(rollout, frame, emphasis)}<br>rules: {rules_text(rollout, frame)}</div>"
    )
