"""The page's process: a server, a scene and a panel, fed by the control process. If it dies, nobody else does."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import socket
import threading
import time

from mild_viz.checkpoint import load_checkpoint
from mild_viz.dashboard.live import status
from mild_viz.dashboard.live.scene import LiveScene
from mild_viz.dashboard.live.start import READY, PageSetup
from mild_viz.dashboard.server import open_server
from mild_viz.dashboard.style import PANEL_CSS, PANEL_WIDTH
from mild_viz.dashboard.tabs.widgets import set_content
from mild_viz.decoding import open_robot
from mild_viz.errors import UserError
from mild_viz.live.feed import Figures, Snapshot, newest

NICE = 5
"""How much the page steps back for the control process, in steps of priority."""

PANEL_PERIOD = 0.2
"""Time between two updates of the panel [s]."""


class LivePage:
    """The page: `show` draws a snapshot."""

    def __init__(self, setup: PageSetup) -> None:
        checkpoint = load_checkpoint(setup.checkpoint)
        robot = open_robot(checkpoint, setup.robot, setup.robot_source)
        self.server = open_server(setup.host, setup.port, "mild_viz live")
        self.server.gui.configure_theme(dark_mode=False, show_logo=False, show_share_button=False)
        self._config = setup.config
        gui = self.server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        gui.add_html(f"<style>{PANEL_CSS}{status.STATUS_CSS}</style>")
        names = {
            "action": setup.action, "variant": setup.variant, "model": checkpoint.name,
            "controller": setup.settings.controller, "input": setup.source, "output": setup.output,
        }  # fmt: skip
        gui.add_html(status.header_html(names))
        self._trouble, self._now, self._chart, self._figures = (gui.add_html("") for _ in range(4))
        self._trouble.visible = False
        with gui.add_folder("Thresholds", expand_by_default=False):
            gui.add_html(status.config_html(setup.config))
        self.scene = LiveScene(
            self.server, checkpoint, setup.variant, setup.action, robot, setup.settings, setup.T_world_human
        )
        self._rolling = status.Rolling()
        self._panel_due = 0.0
        self._last: Snapshot | None = None
        self._heard = time.monotonic()
        self._behind = 0
        """Snapshots that never came here, or were left out for a newer one: their numbers are missing."""
        asyncio.run_coroutine_threadsafe(self._fit_cameras(), self.server.get_event_loop())

    def show(self, now: Snapshot | None) -> None:
        """Draw a snapshot, and the panel if it is time; without one, say for how long none came."""
        clock = time.monotonic()
        if now is not None:
            self._behind += 0 if self._last is None else now.number - self._last.number - 1
            self._last, self._heard = now, clock
            self._rolling.add(now)
            if self.server.get_clients():
                self.scene.follow(now)
        if clock >= self._panel_due:
            self._panel_due = clock + PANEL_PERIOD
            self._write_panel(clock - self._heard)

    def _write_panel(self, silent: float) -> None:
        now = self._last
        figures = Figures() if now is None else now.figures
        trouble = status.trouble_html(figures, silent)
        set_content(self._trouble, trouble)
        if self._trouble.visible != bool(trouble):
            self._trouble.visible = bool(trouble)
        if now is not None and self.server.get_clients():
            set_content(self._now, status.now_html(now, self._config))
            set_content(self._chart, self._rolling.html())
            set_content(self._figures, status.figures_html(figures, self._behind))

    async def _fit_cameras(self) -> None:
        while True:
            await asyncio.sleep(0.25)
            with contextlib.suppress(Exception):  # a browser may leave at any moment
                self.scene.refit_cameras()


def serve(setup: PageSetup, end: socket.socket) -> None:
    """Run the page until the control process ends. Its first word to that process: 'ready', or what is wrong."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches both; the control process ends this one
    _end_with_parent()
    with contextlib.suppress(OSError, AttributeError):
        os.nice(NICE)
    try:
        page = LivePage(setup)
    except UserError as error:
        end.send(str(error).encode()[:4000])
        return
    end.send(READY.encode())
    while True:
        with contextlib.suppress(Exception):  # a frame that cannot be drawn must not end the page
            page.show(newest(end, PANEL_PERIOD))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def wait() -> None:
        parent.join()
        os._exit(0)  # viser's threads would keep the process alive

    threading.Thread(target=wait, name="mild_viz parent", daemon=True).start()
