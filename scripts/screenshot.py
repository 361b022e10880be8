"""Take pictures of the dashboard in headless Chromium: the one in the README, and those to look at after a change.

    python -m scripts.screenshot --out docs --name dashboard            # the README's picture
    python -m scripts.screenshot --out /tmp/shots --dataset nuisi --theme light dark --size 1280x720 1920x1080

Starts the app on a free port of this machine, shows one moment of one trial, and writes NAME-SIZE-THEME.png (or
NAME.png where there is one size and one theme).
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from scripts.render_robot import CHROMIUM
from tests.dashboard_browser import choose, open_page, row, tab


@dataclass
class Options:
    """Take pictures of the dashboard."""

    out: Path
    """Folder for the pictures."""
    name: str = "dashboard"
    dataset: str = "demo"
    action: str = "handshake"
    trial: int | None = None
    checkpoint: Path | None = None
    """Model to show. Default: the one that ships for the dataset."""
    at: float = 0.5
    """Moment to show, as a fraction of the trial."""
    tab: Literal["Trial", "Robot", "States", "Force", "View", "Record"] = "States"
    camera: str = "both"
    size: tuple[str, ...] = ("1280x720",)
    theme: tuple[Literal["light", "dark"], ...] = ("light",)


@contextmanager
def running_app(dataset: str, action: str, trial: int | None, checkpoint: Path | None = None) -> Iterator[str]:
    """The app in a process of its own; yields its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "app.py", "--dataset", dataset, "--action", action, "--port", str(port)]
    command += [] if trial is None else ["--trial", str(trial)]
    command += [] if checkpoint is None else ["--checkpoint", str(checkpoint)]
    process = subprocess.Popen(command)
    url = f"http://127.0.0.1:{port}"
    try:
        for _ in range(600):
            if process.poll() is not None:
                raise SystemExit(f"the app ended with {process.returncode}")
            try:
                urllib.request.urlopen(url, timeout=1)
                break
            except OSError:
                time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(timeout=10)


def main(options: Options) -> None:
    from playwright.sync_api import sync_playwright

    options.out.mkdir(parents=True, exist_ok=True)
    many = len(options.size) * len(options.theme) > 1
    with (
        running_app(options.dataset, options.action, options.trial, options.checkpoint) as url,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=list(CHROMIUM))
        for size in options.size:
            width, height = map(int, size.split("x"))
            page = open_page(browser, url, width, height)
            for theme in options.theme:
                tab(page, "View")
                choose(page, "Theme", theme)
                page.get_by_role("button", name=options.camera.capitalize(), exact=True).click()
                tab(page, options.tab)
                frame = row(page, "frame")
                last = int(frame.get_by_role("slider").get_attribute("aria-valuemax") or 0)
                frame.get_by_role("textbox").fill(str(round(options.at * last)))
                page.mouse.move(width / 3, 5)  # away from every hint
                page.wait_for_timeout(4000)  # the software renderer draws a backlog, the light fades in
                file = options.out / (f"{options.name}-{size}-{theme}.png" if many else f"{options.name}.png")
                page.screenshot(path=str(file))
                print(file)
            page.close()
        browser.close()


if __name__ == "__main__":
    main(tyro.cli(Options))
