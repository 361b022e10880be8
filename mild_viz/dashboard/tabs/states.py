"""Which HMM states are contact: one coloured checkbox per state, and saving the choice into the checkpoint."""

from __future__ import annotations

from html import escape

import viser

from mild_viz.checkpoint import Checkpoint
from mild_viz.dashboard.charts import state_color
from mild_viz.dashboard.tabs.widgets import Changed, on_person, set_content, widget_id
from mild_viz.rollout import Rollout
from mild_viz.trial import CONTACT_ACTIONS

BOX_CSS = """
.mantine-Flex-root:has(> div > p > label[for="ID"]) { flex-direction: row-reverse; justify-content: flex-end; }
.mantine-Flex-root:has(> div > p > label[for="ID"]) > div:first-child {
  width: auto !important; flex: 1; padding-left: 8px;
}
.mantine-Flex-root:has(> div > p > label[for="ID"]) > div:last-child { flex-grow: 0 !important; }
label[for="ID"] { color: var(--mantine-color-text); letter-spacing: -0.2px; cursor: pointer; }
input[id="ID"] { border: 2px solid COLOR; background-color: COLOR44; }
input[id="ID"]:checked { background-color: COLOR; border-color: COLOR; }
"""


SAVE_NOTE = "Saving makes these the model's default for this action, here and in the mild-viz commands."


class StatesTab:
    """Checkboxes of the contact states of the action that is shown."""

    def __init__(self, gui: viser.GuiApi, changed: Changed) -> None:
        self._gui, self._changed = gui, changed
        self._intro = gui.add_html("")
        self._folder = gui.add_folder(None)
        self._boxes: list[viser.GuiCheckboxHandle] = []
        self._of: tuple[object, ...] = ()
        self._unsaved: dict[tuple[object, ...], frozenset[int]] = {}
        """Ticks for what is not shown now, until it is."""
        self.save = gui.add_button(
            "Save contact states", icon=viser.Icon.DEVICE_FLOPPY,
            hint=SAVE_NOTE,
        )  # fmt: skip
        self._saved = gui.add_html("")

    def _build(self, n_states: int) -> None:
        with self._folder:
            for state in range(len(self._boxes), n_states):
                box = self._gui.add_checkbox(
                    f"State {state}", False, hint="Ticked: the partners touch in this state, and mild-ik adapts."
                )
                css = BOX_CSS.replace("ID", widget_id(box)).replace("COLOR", state_color(state))
                self._gui.add_html(f"<style>{css}</style>")
                on_person(box, self._changed)
                self._boxes.append(box)
        for state, box in enumerate(self._boxes):
            box.visible = state < n_states

    def remember(self, checkpoint: Checkpoint, variant: str, action: str, states: frozenset[int]) -> None:
        """Tick these once this model and action are shown."""
        self._unsaved[checkpoint.members(variant)[0].human_vae, action] = states

    def read(self, checkpoint: Checkpoint, variant: str, action: str) -> frozenset[int]:
        """The ticked states. Another model or action brings what is remembered for it, else its own default."""
        human = checkpoint.members(variant)[0].human_vae
        if len(self._boxes) < checkpoint.n_states or self._of[:1] != (human,):
            self._build(checkpoint.n_states)
        if self._of != (human, action):
            if self._of:
                self._unsaved[self._of] = self._ticked()
            self._of = (human, action)
            self.tick(self._unsaved.get(self._of, checkpoint.contact_states_of(variant, action)))
        return self._ticked() & frozenset(range(checkpoint.n_states))

    def _ticked(self) -> frozenset[int]:
        return frozenset(state for state, box in enumerate(self._boxes) if box.value)

    def tick(self, states: frozenset[int]) -> None:
        for state, box in enumerate(self._boxes):
            box.value = state in states

    def compare(self, ticked: frozenset[int], stored: frozenset[int], action: str, model: str) -> None:
        """Say whether the ticked states are what the model has stored; only if not, there is something to save."""
        names = ", ".join(str(state) for state in sorted(stored)) or "no contact states"
        self.save.disabled = ticked == stored
        if ticked == stored:
            self.say_saved(f"Saved: {names} for {action}, the default of model {model}.")
        else:
            self.say_saved(f"Not saved: the default of model {model} for {action} is {names}. {SAVE_NOTE}")

    def say_saved(self, text: str) -> None:
        set_content(self._saved, f'<div class="mv-note">{escape(text)}</div>')

    def show(self, rollout: Rollout) -> None:
        """Write how long and how often each state is active in this trial, and what a tick does."""
        inference = rollout.inference
        action = f"<b>{escape(inference.action)}</b>"
        if inference.action not in CONTACT_ACTIONS:
            text = f"A {action} has no contact; in a ticked state mild-ik would go for the hand."
        elif rollout.contact_states:
            text = f"States of contact in {action}, {inference.variant}: there mild-ik goes for the hand."
        else:
            text = (
                f"No state of {action}, {inference.variant}, is marked as contact: mild-ik moves the robot as decoded. "
                "Tick the states in which the hands meet, and it goes for the hand there. (Recordings such as yumi's "
                "do not tell where the hands met.)"
            )
        set_content(self._intro, f'<div class="mv-note">{text} Mean visit and share of this trial:</div>')
        for state in range(rollout.inference.n_states):
            length, share = rollout.state_durations[state], rollout.state_occupancy[state]
            times = f"{length:.2f} s, {100 * share:.0f} %" if share > 0 else "not visited"
            label = f"State {state}: {times}"
            if self._boxes[state].label != label:
                self._boxes[state].label = label
