"""The page end to end: the real server, the demo set and its shipped model, in headless Chromium."""

from __future__ import annotations

import csv
import io
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from dashboard_browser import (
    choose,
    eventually,
    open_page,
    options,
    rectangle,
    row,
    scene_nodes,
    scene_props,
    slide,
    tab,
    tick,
    wait_ready,
)  # fmt: skip
from PIL import Image

from mild_viz import paths
from mild_viz.checkpoint import load_checkpoint
from mild_viz.dashboard.app import Dashboard, open_dashboard
from mild_viz.dashboard.server import free_port
from mild_viz.errors import UserError
from mild_viz.rollout import Rollout

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
    for name in ("Trial", "Robot", "States", "View", "Record"):
        tab(page, name)
        assert page.evaluate(overflowing) == [], name
        region = page.locator("[data-dock-region='right'] [data-scrollarea-viewport]").first
        assert region.evaluate("e => e.scrollWidth <= e.clientWidth + 1 && e.scrollHeight <= e.clientHeight + 1"), name
    page.set_viewport_size({"width": 1280, "height": 720})
    rectangle(page, "[data-floating-window]")


def test_every_control_has_a_hint(dashboard: Dashboard) -> None:
    hints = {label: props.hint for label, (_, props) in widgets(dashboard).items()}
    assert len(hints) > 25
    assert [label for label, hint in hints.items() if not hint] == []
    assert [label for label, hint in hints.items() if len(hint) > 110] == [], "of one line"


def test_control_settings_rerun_only_the_control(paused: Page, dashboard: Dashboard) -> None:
    page = paused
    tab(page, "Robot")
    first = shown(dashboard)
    decoded = after(dashboard, lambda: choose(page, "Controller", "mild"), 0, 1)
    assert decoded.controller == "mild" and decoded.inference is first.inference
    plain = after(dashboard, lambda: choose(page, "Controller", "base-ik"), 0, 1)
    assert not np.allclose(plain.joints_commanded, decoded.joints_commanded)
    mild_ik = after(dashboard, lambda: choose(page, "Controller", "mild-ik"), 0, 1)
    assert np.array_equal(mild_ik.joints_commanded, first.joints_commanded)
    heavy = after(dashboard, lambda: slide(page, "λq", "2"), 0, 1)
    assert dashboard.session.choice is not None
    assert dashboard.session.choice.settings.control.lambda_q == 100.0
    assert heavy.hand_distance[heavy.contact].mean() > mild_ik.hand_distance[mild_ik.contact].mean()
    assert row(page, "λq = 100").is_visible(), "the weight itself is written, not its exponent"
    after(dashboard, lambda: slide(page, "λq", "-2"), 0, 1)
    after(dashboard, lambda: slide(page, "λx", "-4"), 0, 1)
    assert dashboard.session.choice.settings.control.lambda_x == 1e-4
    after(dashboard, lambda: slide(page, "λx", "0"), 0, 1)
    rough = after(dashboard, lambda: slide(page, "Smoothing", "1"), 0, 1)
    assert not np.array_equal(rough.joints_commanded, first.joints_commanded)
    after(dashboard, lambda: slide(page, "Smoothing", "0.8"), 0, 1)
    stiff = after(dashboard, lambda: tick(page, "Soft in contact", False), 0, 1)
    assert (stiff.stiffness == 1.0).all() and (first.stiffness < 1.0).any()
    again = after(dashboard, lambda: tick(page, "Soft in contact", True), 0, 1)
    assert np.array_equal(again.joints_commanded, first.joints_commanded)


def test_placement_moves_the_human_and_can_be_reset(paused: Page, dashboard: Dashboard) -> None:
    page = paused
    tab(page, "Robot")
    first = shown(dashboard)
    distance = round(first.placement.distance + 0.2, 2)
    before = canvas(page)
    moved = after(dashboard, lambda: slide(page, "Distance", f"{distance}"), 0, 1)
    assert (abs(canvas(page) - before).max(axis=2) > 30).mean() > 0.005, "the human is seen elsewhere"
    assert moved.placement.distance == pytest.approx(distance)
    assert np.linalg.norm(moved.T_world_human[:3, 3] - first.T_world_human[:3, 3]) == pytest.approx(0.2, abs=0.02)
    eventually(
        lambda: "Chosen on this page" in page.locator(".mv-note", has_text="page").first.inner_text(), "it says so"
    )
    back = after(dashboard, lambda: page.get_by_role("button", name="Reset placement").click(), 0, 1)
    assert np.array_equal(back.T_world_human, first.T_world_human)
    assert back.placement.source == first.placement.source


def test_contact_states_gate_the_controller_and_are_saved(paused: Page, dashboard: Dashboard, model: Path) -> None:
    page = paused
    tab(page, "States")
    first = shown(dashboard)
    assert first.contact_states and first.contact.any()
    state = next(iter(first.contact_states))
    for one in sorted(first.contact_states):
        last = after(dashboard, lambda one=one: tick(page, f"State {one}", False), 0, 1)
    assert last.contact_states == frozenset() and not last.contact.any()
    only = after(dashboard, lambda: tick(page, f"State {state}", True), 0, 1)
    assert only.contact_states == {state}
    share = f"{100 * only.state_occupancy[state]:.0f} %" if only.state_occupancy[state] else "not visited"
    assert share in row(page, f"State {state}").inner_text()
    weights = (model / "weights.safetensors").stat()
    page.get_by_role("button", name="Save contact states").click()
    eventually((model / "contact_states.json").is_file, "the choice is saved")
    assert load_checkpoint(model).contact_states["handshake"] == {state}
    assert (model / "weights.safetensors").stat() == weights
    page.get_by_text(f"Saved: {state} for handshake").wait_for()
    for one in sorted(first.contact_states - {state}):
        after(dashboard, lambda one=one: tick(page, f"State {one}", True), 0, 1)


def test_trial_action_and_variant_rerun_everything(paused: Page, dashboard: Dashboard) -> None:
    page = paused
    tab(page, "Trial")
    first = shown(dashboard)
    other = next(name for name in options(page, "Trial") if name != f"test {first.inference.trial}")
    second = after(dashboard, lambda: choose(page, "Trial", other), 1, 1)
    assert f"{second.inference.split} {second.inference.trial}" == other
    assert dashboard.player.frame == 0, "another trial starts at its beginning"
    covariance = after(dashboard, lambda: choose(page, "Variant", "v3.2"), 1, 1)
    assert covariance.inference.variant == "v3.2"
    page.get_by_text("The posterior's spread is").wait_for()
    after(dashboard, lambda: choose(page, "Variant", "v3.1"), 1, 1)
    wave = after(dashboard, lambda: choose(page, "Action", "wave"), 1, 1)
    assert wave.inference.action == "wave"
    header = page.locator(".mv-header").first
    eventually(lambda: "wave" in header.inner_text(), "the header names the action")
    back = after(dashboard, lambda: choose(page, "Action", "handshake"), 1, 1)
    assert back.inference.trial == first.inference.trial


def test_view_settings_rerun_nothing(paused: Page, dashboard: Dashboard) -> None:
    page = paused
    tab(page, "View")
    n = shown(dashboard).inference.active_state[dashboard.player.frame]
    node = f"/latent/human/state{n}"
    opacity = scene_props(page, node)["opacity"]
    after(dashboard, lambda: choose(page, "Opacity by α", "unobserved"), 0, 0)
    eventually(lambda: scene_props(page, node)["opacity"] != opacity, "the ellipsoid's opacity changes")
    assert ">unobserved<" in page.locator(".mv-lane", has_text="Forward variable").inner_html()
    after(dashboard, lambda: choose(page, "Opacity by α", "human"), 0, 0)
    eventually(lambda: scene_props(page, node)["opacity"] == opacity, "it is as before")
    before = canvas(page)
    after(dashboard, lambda: slide(page, "Ellipsoid σ", "2"), 0, 0)
    eventually(lambda: (canvas(page) != before).any(), "the ellipsoids grow")
    after(dashboard, lambda: slide(page, "Ellipsoid σ", "1"), 0, 0)
    after(dashboard, lambda: choose(page, "Latent axes", "dimensions"), 0, 0)
    after(dashboard, lambda: choose(page, "Axis x", "z3"), 0, 0)
    assert dashboard.session.choice is not None and dashboard.session.choice.view.latent_axes == (3, 1, 2)
    after(dashboard, lambda: choose(page, "Axis x", "z0"), 0, 0)
    after(dashboard, lambda: choose(page, "Latent axes", "principal components"), 0, 0)
    before = canvas(page)
    after(dashboard, lambda: tick(page, "Show robot", False), 0, 0)
    assert (abs(canvas(page) - before).max(axis=2) > 30).mean() > 0.01, "the robot is gone"
    after(dashboard, lambda: tick(page, "Show robot", True), 0, 0)
    after(dashboard, lambda: tick(page, "Ghost", False), 0, 0)
    assert not dashboard.session.choice.view.ghost
    after(dashboard, lambda: tick(page, "Ghost", True), 0, 0)


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


def test_a_failing_change_says_why_and_keeps_the_last_good_state(paused: Page, dashboard: Dashboard) -> None:
    page = paused
    tab(page, "View")
    after(dashboard, lambda: choose(page, "Latent axes", "dimensions"), 0, 0)
    good = dashboard.session.choice
    choose(page, "Axis y", "z0")
    page.locator(".mv-error", has_text="three different latent dimensions").wait_for()
    assert page.locator(".mantine-Notification-root", has_text="could not be done").count() == 1
    assert dashboard.session.choice is good and dashboard.session.error is not None
    choose(page, "Axis y", "z1")
    eventually(lambda: page.locator(".mv-error").count() == 0, "the message goes away")
    after(dashboard, lambda: choose(page, "Latent axes", "principal components"), 0, 0)


def test_values_that_no_widget_offers_are_refused(paused: Page, dashboard: Dashboard) -> None:
    """viser takes whatever a websocket sends: the session must not."""
    page = paused
    tab(page, "Robot")
    good = shown(dashboard)
    send = "([uuid, value]) => window.__viserMutable.sendMessage({type: 'GuiUpdateMessage', uuid, updates: {value}})"
    by_label = {label: uuid for label, (uuid, _) in widgets(dashboard).items()}
    page.evaluate(send, [by_label["Controller"], "rm -rf"])
    eventually(lambda: dashboard.session.error, "the unknown controller is refused")
    assert "Controller 'rm -rf' is unknown; valid: base-ik, mild, mild-ik" in str(dashboard.session.error)
    assert shown(dashboard) is good
    after(dashboard, lambda: choose(page, "Controller", "mild"), 0, 1)
    after(dashboard, lambda: choose(page, "Controller", "mild-ik"), 0, 1)
    rollout = after(dashboard, lambda: page.evaluate(send, [by_label["Smoothing"], 1e6]), 0, 1)
    assert dashboard.session.choice is not None
    assert dashboard.session.choice.settings.control.smoothing == 1.0 and np.isfinite(rollout.joints_commanded).all()
    after(dashboard, lambda: slide(page, "Smoothing", "0.8"), 0, 1)


def test_a_dragged_slider_neither_floods_nor_blocks(paused: Page, dashboard: Dashboard) -> None:
    page, session = paused, dashboard.session
    tab(page, "Robot")
    track = row(page, "λq").locator(".mantine-Slider-track").bounding_box()
    assert track is not None
    before = session.n_control, session.n_infer
    page.mouse.move(track["x"] + 2, track["y"] + track["height"] / 2)
    page.mouse.down()
    for i in range(15):
        page.mouse.move(track["x"] + (i + 1) / 15 * track["width"], track["y"] + track["height"] / 2)
    page.mouse.up()
    eventually(
        lambda: session.choice is not None and session.choice.settings.control.lambda_q == 100.0, "the last wins"
    )
    assert session.wait_idle() and session.error is None
    assert 1 <= session.n_control - before[0] <= 16 and session.n_infer == before[1]
    after(dashboard, lambda: slide(page, "λq", "-2"), 0, 1)


def test_recordings_are_downloaded_and_open(
    paused: Page, dashboard: Dashboard, chromium: Browser, tmp_path: Path
) -> None:
    page = paused
    tab(page, "Record")
    with page.expect_download(timeout=60_000) as table:
        page.get_by_role("button", name="Record table (CSV)").click()
    assert table.value.suggested_filename == f"demo-handshake-test-{shown(dashboard).inference.trial}-v3.1-mild-ik.csv"
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
