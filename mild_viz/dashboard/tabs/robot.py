"""What the robot does with the model's prediction: controller, IK weights, smoothing, stiffness, placement."""

from __future__ import annotations

from html import escape

import numpy as np
import viser

from mild_viz.checkpoint import Checkpoint
from mild_viz.dashboard.tabs.widgets import Changed, number, offer, on_person, option, sentence, set_content, widget_id
from mild_viz.robot.control.other_arm import other_arm_options
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Rollout
from mild_viz.settings import CONTROLLERS_OF, OTHER_ARM, ControlSettings, Placement
from mild_viz.trial import Trial

WEIGHT_EXPONENTS = (-4.0, 2.0)
"""Range of the IK weights, as powers of ten."""
MARKS = ((-4.0, "0.0001"), (-2.0, "0.01"), (0.0, "1"), (2.0, "100"))
REACH = 0.5
"""How far a person may move the human from where the recording or the model puts them [m]."""


class RobotTab:
    """Widgets of `ControlSettings`, but for the contact states."""

    def __init__(self, gui: viser.GuiApi, changed: Changed, default: ControlSettings) -> None:
        self._watch = default.watch
        """No widget stands for it: as the page was opened with."""
        self._controller = gui.add_dropdown(
            "Controller", CONTROLLERS_OF["joints"], initial_value=default.controller,
            hint="base-ik: to the hand. mild: as decoded. mild-ik: adapted in contact. task-space: both decoded hands.",
        )  # fmt: skip
        self._other_arm = gui.add_dropdown(
            "Other arm", OTHER_ARM, initial_value=default.other_arm,
            hint="rest. mild: mirrors the decoded joints. base-ik: follows the human's left hand. mild-ik: both.",
        )  # fmt: skip
        self._lambda_x = self._weight(gui, "λx", default.lambda_x, "Weight of reaching the hand (power of ten).")
        self._lambda_q = self._weight(gui, "λq", default.lambda_q, "Weight of staying at the decoded joints.")
        self._smoothing = gui.add_slider(
            "Smoothing", 0.05, 1.0, 0.05, default.smoothing,
            hint="Share of the new command in the moving average; 1 switches smoothing off.",
        )  # fmt: skip
        self._stiffness = gui.add_checkbox(
            "Soft in contact", default.stiffness, hint="Lower the joints' stiffness in the contact of a handshake."
        )
        with gui.add_folder("Placement of the human"):
            self._source = gui.add_html("")
            self._place = {
                axis: gui.add_slider(label, -2.0, 2.0, 0.01, 0.0, marks=(), hint=hint)
                for axis, label, hint in (
                    ("distance", "Distance", "How far in front of the robot's shoulder the human's collar is [m]."),
                    ("lateral", "Lateral", "How far to the robot's left, from its shoulder [m]."),
                    ("height", "Height", "Of the human's collar over the robot's shoulder [m]."),
                )
            }
            self._reset = gui.add_button("Reset placement", icon=viser.Icon.RESTORE, hint="Back to where it came from.")
        self._own: dict[str, float] = {}
        """Where the trial's own placement put the sliders; empty until it did."""
        self._chosen: Placement | None = None
        self._to_reset = False
        self._of: tuple[object, ...] = ()
        widgets = (self._controller, self._other_arm, self._lambda_x, self._lambda_q, self._smoothing, self._stiffness)
        for handle in (*widgets, *self._place.values()):
            on_person(handle, changed)

        @self._reset.on_click
        def _(_event: viser.GuiEvent) -> None:
            self._to_reset = True
            changed()

    @staticmethod
    def _weight(gui: viser.GuiApi, name: str, value: float, hint: str) -> viser.GuiSliderHandle[float]:
        slider = gui.add_slider(
            f"{name} = {value:g}", *WEIGHT_EXPONENTS, 0.05, float(np.log10(value)), marks=MARKS, hint=hint
        )
        # The box holds the exponent: say so in front of it.
        box = f'div:has(> [id="{widget_id(slider)}"]) > .mantine-InputWrapper-root'
        gui.add_html(
            f"<style>{box} {{ position: relative; }} {box} input {{ padding-left: 20px !important; }}"
            f'{box}::before {{ content: "10^"; position: absolute; left: 4px; top: 6px; z-index: 1; font-size: 10px;'
            " color: var(--mantine-color-dimmed); }</style>"
        )
        return slider

    def read(
        self, checkpoint: Checkpoint, trial: Trial, robot: RobotModel, contact_states: frozenset[int]
    ) -> ControlSettings:
        """The chosen settings, of what this robot and model can do. The placement is the trial's own until moved."""
        controllers = CONTROLLERS_OF[checkpoint.decodes]
        chosen = option(self._controller)
        offer(self._controller, controllers, chosen if chosen in controllers else controllers[-1])
        # A model of two hands moves both arms itself.
        others = ("rest",) if checkpoint.decodes == "hands" else other_arm_options(robot, trial.human_skeleton)
        self._other_arm.disabled = len(others) < 2
        offer(self._other_arm, others or ("rest",))
        weights = {}
        for name, slider in (("λx", self._lambda_x), ("λq", self._lambda_q)):
            weights[name] = float(f"{10.0 ** number(slider):.3g}")
            label = f"{name} = {weights[name]:g}"
            if slider.label != label:
                slider.label = label
        return ControlSettings(
            controller=option(self._controller),
            other_arm=option(self._other_arm),
            lambda_x=weights["λx"],
            lambda_q=weights["λq"],
            contact_states=contact_states,
            stiffness=bool(self._stiffness.value),
            smoothing=number(self._smoothing),
            placement=self._placement(checkpoint, trial),
            watch=self._watch,
        )

    def _placement(self, checkpoint: Checkpoint, trial: Trial) -> Placement | None:
        # A recording with one world frame has its own placement per trial; else it is the model's for all.
        of = (checkpoint.human_vae, trial.name if trial.T_world_human is not None else trial.dataset)
        if of != self._of or self._to_reset:
            self._of, self._to_reset, self._chosen, self._own = of, False, None, {}
        if not self._own:
            return None  # the sliders do not stand for this trial yet
        values = {axis: number(slider) for axis, slider in self._place.items()}
        if self._chosen is not None or values != self._own:
            self._chosen = Placement(values["distance"], values["lateral"], values["height"], "chosen on this page")
        return self._chosen

    def show(self, rollout: Rollout) -> None:
        """Put the sliders where the human stands, and say where that comes from."""
        if not self._own:  # only then: a slider that a person is moving must not be touched
            self._own = {axis: round(float(getattr(rollout.placement, axis)), 2) for axis in self._place}
            for axis, slider in self._place.items():
                value = self._own[axis]
                slider.min, slider.max = round(value - REACH, 2), round(value + REACH, 2)
                slider.value = value
        self._reset.disabled = self._chosen is None
        # What has no effect on this rollout is not to be moved.
        for slider in (self._lambda_x, self._lambda_q):
            slider.disabled = rollout.controller != "mild-ik"
        self._stiffness.disabled = not rollout.compliant
        set_content(self._source, f'<div class="mv-note">{escape(sentence(rollout.placement.source))}</div>')
