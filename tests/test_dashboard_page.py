"""The page end to end: the real server, the demo set and its shipped model, in headless Chromium."""

from __future__ import annotations

import csv
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from dashboard_browser import (
    after,
    canvas,
    choose,
    eventually,
    open_page,
    rectangle,
    row,
    scene_nodes,
    shown,
    tab,
    tick,
    wait_ready,
)

from mild_viz.dashboard.app import Dashboard, open_dashboard
from mild_viz.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytest_plugins = ["dashboard_page_fixtures"]


def test_the_page_shows_three_groups(page: Page, dashboard: Dashboard) -> None:
    nodes = scene_nodes(page)
    for group in ("/human", "/robot", "/latent"):
        assert any(node.startswith(f"{group}/") for node in nodes), group
    picture = canvas(page)
    saturated = picture.max(axis=2) - picture.min(axis=2) > 40
    third = picture.shape[1] // 3
    for i in range(3):
        drawn = (picture[:, i * third : (i + 1) * third] < 235).any(axis=2)
        assert drawn.mean() > 0.01, f"third {i} of the scene is empty"
    assert saturated.mean() > 0.003, "the human's red arm and the states' colours are to be seen"
    assert "demo" in page.locator(".mv-header").first.inner_text()


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1920, 1080)])
def test_nothing_overlaps_or_overflows(paused: Page, dashboard: Dashboard, width: int, height: int) -> None:
    page = paused
    page.set_viewport_size({"width": width, "height": height})
    page.wait_for_timeout(500)
    scene = rectangle(page, "canvas[data-engine]")
    panel = rectangle(page, "[data-dock-region='right']")
    timeline = rectangle(page, "[data-floating-window]:has(.mv-timeline)")
    assert panel[2] == pytest.approx(width, abs=1) and panel[3] == pytest.approx(height, abs=1)
    assert timeline[0] == pytest.approx(0, abs=1) and timeline[3] == pytest.approx(height, abs=1)
    assert timeline[2] == pytest.approx(panel[0], abs=2) and scene[2] == pytest.approx(panel[0], abs=2)
    assert scene[3] == pytest.approx(timeline[1], abs=2)
    assert scene[3] - scene[1] > 0.5 * height and scene[2] - scene[0] > 0.7 * width
    # The time cursor of every chart is under the scrub bar's thumb.
    dashboard.player.seek(dashboard.player.n_frames - 1)

    def middle(selector: str) -> float:
        left, _, right, _ = rectangle(page, selector)
        return (left + right) / 2

    thumb, cursor = "[data-floating-window] .mantine-Slider-thumb", ".mv-joints .mv-cursor"
    eventually(lambda: middle(cursor) > 0.95 * panel[0] - 64, "the cursor goes to the end")
    eventually(lambda: middle(thumb) == pytest.approx(middle(cursor), abs=2.5), "the thumb stands over the cursor")
    assert rectangle(page, ".mv-axis")[3] <= height
    overflowing = """() => [...document.querySelectorAll('.mv-name, .mv-now, .mv-range span, .mv-header, .mv-note')]
        .filter(e => e.offsetParent && (e.scrollWidth > e.clientWidth + 1) && getComputedStyle(e).display !== 'inline')
        .map(e => e.innerText)"""
    for name in ("Trial", "Robot", "States", "Force", "View", "Record"):
        tab(page, name)
        assert page.evaluate(overflowing) == [], name
        region = page.locator("[data-dock-region='right'] [data-scrollarea-viewport]").first
        assert region.evaluate("e => e.scrollWidth <= e.clientWidth + 1 && e.scrollHeight <= e.clientHeight + 1"), name
    page.set_viewport_size({"width": 1280, "height": 720})
    rectangle(page, "[data-floating-window]")


def test_camera_presets_move_this_browsers_camera(paused: Page, dashboard: Dashboard) -> None:
    page = paused
    tab(page, "View")
    client = next(iter(dashboard.server.get_clients().values()))
    places = []
    for name in ("Participant", "Experimenter", "Latent", "Both"):
        page.get_by_role("button", name=name, exact=True).click()
        page.wait_for_timeout(500)
        places.append(tuple(client.camera.position.round(3)))
    assert len(set(places)) == 4


def test_dark_theme(paused: Page, dashboard: Dashboard) -> None:
    page = paused
    tab(page, "View")
    assert canvas(page).mean() > 150
    after(dashboard, lambda: choose(page, "Theme", "dark"), 0, 0)
    eventually(
        lambda: page.evaluate("document.documentElement.dataset.mantineColorScheme") == "dark", "the page is dark"
    )
    assert canvas(page).mean() < 90
    after(dashboard, lambda: choose(page, "Theme", "light"), 0, 0)


def test_playing_advances_scene_charts_and_text(paused: Page, dashboard: Dashboard) -> None:
    page, player = paused, dashboard.player
    player.seek(0)
    page.get_by_role("button", name="Play", exact=True).click()
    eventually(lambda: player.frame > 10, "playback advances")
    page.get_by_role("button", name="Pause", exact=True).click()
    eventually(lambda: not player.playing, "playback pauses")
    page.wait_for_timeout(400)
    frame = player.frame
    assert page.locator("[data-floating-window] input.mantine-NumberInput-input").input_value() == str(frame)
    cursor = page.evaluate("getComputedStyle(document.querySelector('.mv-lane')).getPropertyValue('--mv-time')")
    assert float(cursor) == pytest.approx(100 * frame / (player.n_frames - 1), abs=0.01)
    assert f"{shown(dashboard).inference.time[frame]:.2f} s" in page.locator(".mv-now").inner_text()


def test_keys(paused: Page, dashboard: Dashboard) -> None:
    page, player = paused, dashboard.player
    page.locator(".mv-header").first.click()  # away from any text box
    page.keyboard.press("Home")
    eventually(lambda: player.frame == 0, "Home goes to the first frame")
    page.keyboard.press("End")
    eventually(lambda: player.frame == player.n_frames - 1, "End goes to the last frame")
    page.keyboard.press("j")
    eventually(lambda: player.frame == player.n_frames - 2, "J steps back")
    page.keyboard.press("k")
    eventually(lambda: player.frame == player.n_frames - 1, "K steps forward")
    page.keyboard.press("Home")
    page.keyboard.press("Space")
    eventually(lambda: player.playing and player.frame > 3, "Space plays")
    page.keyboard.press("Space")
    eventually(lambda: not player.playing, "Space pauses")
    # A focused Play button must not turn one press of Space into two.
    page.get_by_role("button", name="Play", exact=True).click()
    eventually(lambda: player.playing, "the button plays")
    page.wait_for_timeout(300)
    page.keyboard.press("Space")
    page.wait_for_timeout(500)
    assert not player.playing


def test_scrubbing_speed_and_loop(paused: Page, dashboard: Dashboard) -> None:
    page, player = paused, dashboard.player
    page.locator("[data-floating-window] input.mantine-NumberInput-input").fill("7")
    eventually(lambda: player.frame == 7, "the box scrubs")
    left, top, right, bottom = rectangle(page, "[data-floating-window] .mantine-Slider-track")
    page.mouse.move(left + 0.25 * (right - left), (top + bottom) / 2)
    page.mouse.down()
    for share in (0.3, 0.5, 0.75):
        page.mouse.move(left + share * (right - left), (top + bottom) / 2)
        page.wait_for_timeout(80)
    page.mouse.up()
    eventually(lambda: player.frame == pytest.approx(0.75 * (player.n_frames - 1), abs=1.5), "the bar scrubs")
    choose(page, "speed", "4×")
    eventually(lambda: player.speed == 4.0, "the speed is taken over")
    choose(page, "speed", "1×")
    tick(page, "loop", False)
    eventually(lambda: not player.loop, "the loop is off")
    tick(page, "loop", True)
    eventually(lambda: player.loop and player.speed == 1.0, "all is as before")


def test_a_click_into_the_charts_goes_there_and_can_be_dragged(paused: Page, dashboard: Dashboard) -> None:
    last = dashboard.player.n_frames - 1
    for lane, share in ((".mv-fired .mv-plot", 0.25), (".mv-strip", 0.6)):
        left, top, right, _ = rectangle(paused, lane)
        paused.mouse.click(left + share * (right - left), top + 4)
        eventually(lambda share=share: abs(dashboard.player.frame - share * last) <= 1, f"frame at {share} of {lane}")
    left, top, right, _ = rectangle(paused, ".mv-joints .mv-plot")
    paused.mouse.move(left + 0.3 * (right - left), top + 4)
    paused.mouse.down()
    paused.mouse.move(left + 0.8 * (right - left), top + 4, steps=3)
    paused.mouse.up()
    eventually(lambda: abs(dashboard.player.frame - 0.8 * last) <= 1, "the drag ended at 0.8 of the trial")
    paused.mouse.move(left + 0.1 * (right - left), top + 4)
    paused.wait_for_timeout(300)
    assert abs(dashboard.player.frame - 0.8 * last) <= 1, "the mouse was let go"


def test_recordings_are_downloaded_and_open(
    paused: Page, dashboard: Dashboard, chromium: Browser, tmp_path: Path
) -> None:
    page = paused
    tab(page, "Record")
    with page.expect_download(timeout=60_000) as table:
        page.get_by_role("button", name="Record table (CSV)").click()
    trial = shown(dashboard).inference.trial
    assert table.value.suggested_filename == f"demo-handshake-test-{trial}-demo-copy-v3.1-mild-ik.csv"
    table.value.save_as(tmp_path / "table.csv")
    with open(tmp_path / "table.csv", newline="") as file:
        rows = list(csv.reader(file))
    assert len(rows) == shown(dashboard).inference.n_windows + 1
    with page.expect_download(timeout=90_000) as download:
        page.get_by_role("button", name="Record page (HTML)").click()
    download.value.save_as(tmp_path / "recording.html")
    recording = chromium.new_page()
    recording.context.set_offline(True)
    recording.goto((tmp_path / "recording.html").as_uri())
    recording.wait_for_function(
        "() => ['/human', '/robot', '/latent'].every(g => "
        "Object.keys(window.__viserSceneTree?.getState() ?? {}).some(n => n.startsWith(g)))",
        timeout=60_000,
    )
    recording.close()


def test_two_browsers_see_the_same(paused: Page, dashboard: Dashboard, chromium: Browser) -> None:
    other = open_page(chromium, dashboard.url, 900, 650)
    tab(paused, "Robot")
    after(dashboard, lambda: choose(paused, "Controller", "mild"), 0, 1)
    header = other.locator(".mv-header").first
    eventually(lambda: "controller mild\n" in header.inner_text() + "\n", "the second browser follows")
    tab(other, "Robot")
    assert row(other, "Controller").get_by_role("combobox").input_value() == "mild"
    after(dashboard, lambda: choose(other, "Controller", "mild-ik"), 0, 1)
    eventually(lambda: "mild-ik" in paused.locator(".mv-header").first.inner_text(), "the first browser follows")
    other.close()


def test_a_browser_closed_in_mid_play_disturbs_nobody(paused: Page, dashboard: Dashboard, chromium: Browser) -> None:
    player = dashboard.player
    other = open_page(chromium, dashboard.url, 900, 650)
    player.seek(0)
    player.toggle()
    eventually(lambda: player.frame > 5, "playback advances")
    other.close()
    eventually(lambda: len(dashboard.server.get_clients()) == 1, "the server sees it go")
    frame = player.frame
    eventually(lambda: player.frame != frame, "playback goes on")
    assert player.playing and dashboard.session.error is None
    # Without any browser time stands still, and a new one finds the page as it was left.
    paused.goto("about:blank")
    eventually(lambda: not dashboard.server.get_clients(), "the last browser is gone")
    time.sleep(0.2)
    frame = player.frame
    time.sleep(0.4)
    assert player.frame == frame and player.playing
    paused.goto(dashboard.url)
    wait_ready(paused)
    eventually(lambda: player.frame != frame, "playback goes on for the new browser")
    player.playing = False


def test_a_second_dashboard_on_the_same_port_is_refused(dashboard: Dashboard, model: Path) -> None:
    port = dashboard.server.get_port()
    with pytest.raises(UserError, match=f"port {port} is already in use; the next free one is"):
        open_dashboard(checkpoint=model, port=port)
