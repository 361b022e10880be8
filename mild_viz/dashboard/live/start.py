"""Starts the page's process from the control process, which itself never imports a server."""

from __future__ import annotations

import multiprocessing
import socket
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.live.config import LiveConfig
from mild_viz.live.feed import Feed, channel, wait_for
from mild_viz.live.loop import LiveLoop, Tick
from mild_viz.robot.source import RobotSource
from mild_viz.settings import ControlSettings

if TYPE_CHECKING:
    from mild_viz.live.record import Recorder

READY = "ready"
"""The page's first word, unless it is what is wrong."""


@dataclass(frozen=True, eq=False)
class PageSetup:
    """What the page must know of the run. It reads model and robot itself."""

    host: str
    port: int
    checkpoint: Path
    variant: str
    action: str
    robot: str | None
    """As `open_robot` takes it, like the next."""
    robot_source: RobotSource
    settings: ControlSettings
    T_world_human: Float[np.ndarray, "4 4"]
    config: LiveConfig
    source: str
    output: str


class PageProcess:
    """The running page: a witness of the control loop, whose end is no matter to it."""

    def __init__(self, feed: Feed, process: BaseProcess) -> None:
        self.feed, self.process = feed, process

    def __call__(self, tick: Tick) -> None:
        self.feed(tick)

    def close(self) -> None:
        """End the page's process."""
        self.feed.close()
        self.process.terminate()
        self.process.join(timeout=3.0)
        if self.process.is_alive():
            self.process.kill()
            self.process.join(timeout=3.0)


def start_page(setup: PageSetup, loop: LiveLoop, recorder: Recorder | None, timeout: float) -> PageProcess:
    """Start the page and wait until it stands, for `timeout` [s] at most.

    Raises:
        UserError: with what is wrong, such as a port that is taken.
    """
    ours, theirs = channel()
    # Spawned, not forked: the page gets nothing of what this process has loaded, and no thread of it.
    process = multiprocessing.get_context("spawn").Process(
        target=_serve, args=(setup, theirs), name="mild_viz live page", daemon=True
    )
    process.start()
    page = PageProcess(Feed(loop, ours, setup.config.page_rate, recorder), process)
    theirs.close()
    word = wait_for(ours, process.is_alive, timeout)
    if word != READY:
        page.close()
        raise UserError(word)
    return page


def _serve(setup: PageSetup, end: socket.socket) -> None:
    from mild_viz.dashboard.live.page import serve

    serve(setup, end)
