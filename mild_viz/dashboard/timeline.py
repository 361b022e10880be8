"""The timeline's widgets: transport, scrub bar, and the charts of `charts.py` under one time cursor."""

from __future__ import annotations

from collections.abc import Callable

import viser

from mild_viz.dashboard import charts
from mild_viz.dashboard.player import SPEEDS, Player
from mild_viz.dashboard.readout import distance_html, state_html, stiffness_text
from mild_viz.dashboard.style import CHART_CSS, FLOATING_SIZE, TIMELINE_CSS
from mild_viz.rollout import Rollout
from mild_viz.simulation.compare import Comparison

FIRST, BACK, PLAY, PAUSE, STEP, LAST = "First", "Back", "Play", "Pause", "Step", "Last"


class Timeline:
    """The panel below the scene. It shows one rollout and moves the player."""

    def __init__(self, server: viser.ViserServer, player: Player) -> None:
        self._player = player
        self._rollout: Rollout | None = None
        gui = server.gui
        panel = gui.add_panel()
        with panel.add_tab("Timeline"):
            gui.add_html(f'<style>{TIMELINE_CSS}{CHART_CSS}</style><div class="mv-timeline"></div>')
            self._transport = gui.add_button_group("", (FIRST, BACK, PLAY, STEP, LAST), hint=HINT_TRANSPORT)
            self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1×", hint="How fast the trial plays.")
            self._loop = gui.add_checkbox("loop", player.loop, hint="Start again at the end.")
            self._now = gui.add_html("")
            self._frame = gui.add_slider(
                "frame",
                0,
                1,
                1,
                0,
                marks=(),
                hint="Drag the frame bar to any frame; the box takes a number.",
            )
            self._cursor = gui.add_html(charts.cursor_html(0.0))
            self._lanes = {name: gui.add_html('<div class="mv-lane"></div>') for name in charts.LANES}
            self._force = gui.add_html("")
        panel.float(x=10, y=-10, width=FLOATING_SIZE[0], height=FLOATING_SIZE[1])
        self._connect()
        self._add_hotkeys(gui)

    def _connect(self) -> None:
        """Widgets that were moved by a browser (not by us: then `client_id` is None) move the player."""
        player = self._player
        actions: dict[str, Callable[[], None]] = {
            FIRST: lambda: player.seek(0),
            BACK: lambda: player.step(-1),
            PLAY: player.toggle,
            PAUSE: player.toggle,
            STEP: lambda: player.step(1),
            LAST: lambda: player.seek(player.n_frames - 1),
        }

        @self._transport.on_click
        def _(event: viser.GuiEvent) -> None:
            action = actions.get(self._transport.value)
            if event.client_id is not None and action is not None:
                action()

        @self._speed.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None and self._speed.value in SPEEDS:
                player.speed = SPEEDS[self._speed.value]

        @self._loop.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                player.loop = bool(self._loop.value)

        # On the loop, unlike the others: there the player writes the bar ten times a second, and a value that was
        # read a moment later in another thread could be the player's and not the person's.
        @self._frame.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client_id is not None:
                player.scrub(int(self._frame.value))

    def _add_hotkeys(self, gui: viser.GuiApi) -> None:
        player = self._player
        commands: tuple[tuple[str, str, Callable[[], None]], ...] = (
            ("Play or pause", "space", player.toggle),
            ("One frame back", "J", lambda: player.step(-1)),
            ("One frame forward", "K", lambda: player.step(1)),
            ("First frame", "home", lambda: player.seek(0)),
            ("Last frame", "end", lambda: player.seek(player.n_frames - 1)),
        )
        for label, key, action in commands:
            command = gui.add_command(label, hotkey=key)  # pyright: ignore[reportArgumentType]

            @command.on_trigger
            def _(_event: object, action: Callable[[], None] = action) -> None:
                action()

    def show(self, rollout: Rollout, alpha_mode: str) -> None:
        """Draw the charts of a rollout; a lane that did not change is not sent again."""
        self._rollout = rollout
        last = max(rollout.inference.n_windows - 1, 1)
        if self._frame.max != last:
            self._frame.max = last
        for name, html in charts.draw_lanes(rollout, alpha_mode).items():
            if self._lanes[name].content != html:
                self._lanes[name].content = html

    def show_force(self, comparison: Comparison | None) -> None:
        """Draw the force between the hands, or take its lane away; `show` comes first."""
        if self._rollout is not None:
            self._set(self._force, "" if comparison is None else charts.force_lane(self._rollout, comparison))

    def tick(self, frame: int, playing: bool) -> None:
        """Follow the player: scrub bar, cursor, text (ten times a second at most)."""
        rollout = self._rollout
        if rollout is None:
            return
        frame = min(frame, rollout.inference.n_windows - 1)
        options = (FIRST, BACK, PAUSE if playing else PLAY, STEP, LAST)
        if self._transport.options != options:
            self._transport.options = options
        self._frame.value = frame
        self._set(self._cursor, charts.cursor_html(frame / max(rollout.inference.n_windows - 1, 1)))
        self._set(self._now, _now(rollout, frame))

    @staticmethod
    def _set(handle: viser.GuiHtmlHandle, content: str) -> None:
        if handle.content != content:
            handle.content = content


HINT_TRANSPORT = "Keys: Space plays and pauses, J and K step, Home and End jump. Or drag the frame bar below."


def _now(rollout: Rollout, frame: int) -> str:
    """What holds at the cursor, in parts that stay whole where the line must be broken."""
    time = rollout.inference.time
    parts = (
        f"<b>{time[frame]:.2f} s</b> of {time[-1]:.2f} s",
        state_html(rollout, frame),
        stiffness_text(rollout, frame),
        distance_html(rollout, frame),
    )
    return f'<div class="mv-now">{" ".join(f"<span>{part}</span>" for part in parts)}</div>'
