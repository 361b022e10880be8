"""A browser on the page: waiting until it stands, and moving its widgets as a person would."""

from __future__ import annotations

import io
import re
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

    from mild_viz.dashboard.app import Dashboard
    from mild_viz.rollout import Rollout

READY = """() => {
  const nodes = Object.keys(window.__viserSceneTree?.getState() ?? {});
  const groups = ['/human', '/robot', '/latent'];
  const mutable = window.__viserMutable;
  return groups.every(g => nodes.some(n => n.startsWith(g))) && mutable?.messageQueue?.length === 0
    && (window.__viserTestpoints?.rendererInfo?.render?.frame ?? 0) > 3
    && document.querySelector('.mv-states .mv-strip') !== null;
}"""

LABEL = """label => [...document.querySelectorAll('label')].some(l => l.textContent === label)"""


def eventually(condition: Callable[[], Any], what: str, timeout: float = 20.0) -> Any:
    """The condition's value as soon as it is true."""
    deadline = time.monotonic() + timeout
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError(f"in {timeout:g} s it did not happen that {what}")


def wait_ready(page: Page) -> None:
    """Wait until the scene has its three groups and something is drawn; put viser's own warnings away."""
    page.wait_for_function(READY, timeout=60_000)
    for button in page.locator(".mantine-Notification-closeButton").all():
        button.click()


def open_page(browser: Any, url: str, width: int = 1280, height: int = 720) -> Page:
    """A new browser window on the page."""
    page = browser.new_page(viewport={"width": width, "height": height}, accept_downloads=True)
    page.goto(url)
    wait_ready(page)
    return page


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()
    page.wait_for_timeout(200)


def row(page: Page, label: str) -> Locator:
    """The row of the widget whose label begins with `label`."""
    found = page.locator("label", has_text=re.compile(f"^{re.escape(label)}")).locator("visible=true").first
    return found.locator("xpath=ancestor::div[contains(@class,'mantine-Flex-root')][1]")


def choose(page: Page, label: str, option: str) -> None:
    row(page, label).get_by_role("combobox").click()
    page.get_by_role("option", name=option, exact=True).locator("visible=true").click()


def options(page: Page, label: str) -> list[str]:
    row(page, label).get_by_role("combobox").click()
    names = page.get_by_role("option").locator("visible=true").all_inner_texts()
    page.keyboard.press("Escape")
    return names


def slide(page: Page, label: str, value: str) -> None:
    """Type a slider's value into its box."""
    row(page, label).get_by_role("textbox").fill(value)


def tick(page: Page, label: str, on: bool) -> None:
    row(page, label).get_by_role("checkbox").set_checked(on)


def scene_props(page: Page, name: str) -> dict[str, Any]:
    """What the browser knows of a node of the scene."""
    return page.evaluate("name => window.__viserSceneTree.getState()[name]?.message.props ?? {}", name)


def scene_nodes(page: Page) -> list[str]:
    return page.evaluate("() => Object.keys(window.__viserSceneTree.getState())")


def rectangle(page: Page, selector: str) -> tuple[float, float, float, float]:
    """Left, top, right, bottom of an element [px], once it rests: viser eases its panels to new sizes."""
    last = None
    for _ in range(50):
        box = page.locator(selector).first.bounding_box()
        assert box is not None, f"{selector} is not on the page"
        if box == last:
            break
        last = box
        page.wait_for_timeout(150)
    return box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]


def shown(dashboard: Dashboard) -> Rollout:
    assert dashboard.session.rollout is not None
    return dashboard.session.rollout


def after(dashboard: Dashboard, action: Callable[[], Any], infer: int, control: int) -> Rollout:
    """The rollout after an action that must rerun inference and control so many times."""
    session = dashboard.session
    before = session.n_infer, session.n_control, session.n_shown
    action()
    eventually(lambda: session.n_shown > before[2], "the page shows something new")
    assert session.wait_idle() and session.error is None
    assert (session.n_infer - before[0], session.n_control - before[1]) == (infer, control)
    time.sleep(0.15)  # viser's own throttle of a browser's messages
    return shown(dashboard)


def widgets(dashboard: Dashboard) -> dict[str, tuple[str, Any]]:
    """Id and properties of every widget by its label."""
    handles: list[Any] = list(dashboard.server.gui._gui_input_handle_from_uuid.values())
    found = {handle._impl.props.label: (handle._impl.uuid, handle._impl.props) for handle in handles}
    assert len(found) == len(handles), "no two have the same label"
    return found


def canvas(page: Page) -> np.ndarray:
    """The scene's pixels, once two pictures in a row are the same (at most some seconds)."""
    place = page.locator("canvas[data-engine]")
    last = b""
    for _ in range(12):
        page.wait_for_timeout(300)
        picture = place.screenshot()
        if picture == last:
            break
        last = picture
    return np.asarray(Image.open(io.BytesIO(last)).convert("RGB")).astype(int)
