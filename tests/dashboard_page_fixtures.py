"""One dashboard on the demo set and one browser on it, for all end-to-end tests of a module (a pytest plugin)."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from dashboard_browser import open_page

from mild_viz import paths
from mild_viz.dashboard.app import Dashboard, open_dashboard
from mild_viz.dashboard.server import free_port

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

HOST = "127.0.0.1"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the demo model: contact states are saved into its folder."""
    return Path(shutil.copytree(paths.default_checkpoint("demo"), tmp_path_factory.mktemp("models") / "demo-copy"))


@pytest.fixture(scope="module")
def dashboard(model: Path) -> Iterator[Dashboard]:
    port = free_port(HOST, 18_000)
    assert port is not None
    dashboard = open_dashboard(checkpoint=model, dataset="demo", action="handshake", port=port)
    assert dashboard.session.wait_idle() and dashboard.session.error is None
    yield dashboard
    dashboard.stop()


@pytest.fixture(scope="module")
def page(chromium: Browser, dashboard: Dashboard) -> Iterator[Page]:
    page = open_page(chromium, dashboard.url)
    yield page
    page.close()


@pytest.fixture
def paused(page: Page, dashboard: Dashboard) -> Page:
    """The page, paused in the middle of the trial."""
    dashboard.player.playing = False
    dashboard.player.seek(dashboard.player.n_frames // 2)
    page.wait_for_timeout(200)
    return page
