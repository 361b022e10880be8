"""Every control of the page end to end: what it reruns, what it changes, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from dashboard_browser import (
    after,
    canvas,
    choose,
    eventually,
    options,
    row,
    scene_props,
    shown,
    slide,
    tab,
    tick,
    widgets,
)

from mild_viz.checkpoint import load_checkpoint
from mild_viz.dashboard.app import Dashboard
from mild_viz.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytest_plugins = ["dashboard_page_fixtures"]


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
    row(page, "λq = 100").wait_for()  # the weight itself is written, not its exponent
    after(dashboard, lambda: slide(page, "λq", "-2"), 0, 1)
    after(dashboard, lambda: slide(page, "λx", "-4"), 0, 1)
    assert dashboard.session.choice.settings.control.lambda_x == 1e-4
    after(dashboard, lambda: slide(page, "λx", "0"), 0, 1)
    rough = after(dashboard, lambda: slide(page, "Smoothing", "1"), 0, 1)
    assert not np.array_equal(rough.joints_commanded, first.joints_commanded)
    after(dashboard, lambda: slide(page, "Smoothing", "0.8"), 0, 1)
    stiff = after(dashboard, lambda: tick(page, "Soft in contact", False), 0, 1)
    assert (stiff.stiffness == 1.0).all() and (first.stiffness < 1.0).any()
    after(dashboard, lambda: tick(page, "Soft in contact", True), 0, 1)
    both = after(dashboard, lambda: choose(page, "Other arm", "mild"), 0, 1)
    assert [arm.controller for arm in both.other_arms] == ["mild"]
    left = both.link_names.index("LForeArm")
    assert np.ptp(both.link_poses[:, left], axis=0).max() > 0.05 > np.ptp(first.link_poses[:, left], axis=0).max()
    again = after(dashboard, lambda: choose(page, "Other arm", "rest"), 0, 1)
    assert np.array_equal(again.joints_commanded, first.joints_commanded)


def test_the_page_simulates_when_asked(paused: Page, dashboard: Dashboard) -> None:
    page, stage = paused, dashboard.compliance
    n_control = dashboard.session.n_control
    assert page.locator(".mv-force").count() == 0
    tab(page, "Force")
    tick(page, "Simulate", True)
    page.get_by_text("Force, peak [N]").wait_for(timeout=20_000)
    page.locator(".mv-force polyline").first.wait_for(state="attached")
    assert dashboard.session.wait_idle() and stage.n_simulated == 1
    eventually(lambda: (scene_props(page, "/compliance/text") or {}).get("text"), "the force is written")
    below = ("Robot hand to wrist", "Hand force", "time")
    names = {name: page.locator(f".mv-lane .mv-name:has-text('{name}')").bounding_box() for name in below}
    tops = [box["y"] for box in names.values() if box is not None]
    assert len(tops) == len(below) and tops == sorted(tops), "force is between distance and time"
    choose(page, "Stiffness", "full")  # drawn from what is there
    choose(page, "Shaking by", "human alone")
    eventually(lambda: stage.n_simulated == 2, "the other scenario is simulated")
    choose(page, "Shaking by", "robot as commanded")
    page.wait_for_timeout(300)
    assert dashboard.session.wait_idle() and stage.n_simulated == 2, "what was simulated is kept"
    assert dashboard.session.n_control == n_control, "the rollout is not run again"
    tick(page, "Simulate", False)
    eventually(lambda: page.locator(".mv-force").count() == 0, "the lane goes")
    assert not row(page, "Shaking by").count()


def test_a_robot_without_inertia_says_so_in_its_tab(
    paused: Page, dashboard: Dashboard, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise UserError("nothing that joint 'x' moves has an <inertial>")

    monkeypatch.setattr("mild_viz.dashboard.compliance.compare", refuse)
    page = paused
    tab(page, "Force")
    dashboard.compliance._found.clear()
    tick(page, "Simulate", True)
    page.get_by_text("Not simulated: nothing that joint 'x' moves has an <inertial>.").wait_for(timeout=20_000)
    assert dashboard.session.error is None
    tick(page, "Simulate", False)


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
        lambda: "Chosen on this page" in page.locator(".mv-note", has_text="this page").first.inner_text(), "it says so"
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
    assert page.get_by_role("button", name="Save contact states").is_disabled()
    for one in sorted(first.contact_states - {state}):
        after(dashboard, lambda one=one: tick(page, f"State {one}", True), 0, 1)
        page.get_by_text("Not saved: ").wait_for()
    tab(page, "Trial")
    after(dashboard, lambda: choose(page, "Variant", "v4"), 1, 1)
    back = after(dashboard, lambda: choose(page, "Variant", "v3.1"), 1, 1)
    assert back.contact_states == first.contact_states != {state}, "what was ticked, though it was not saved"
    tab(page, "States")
    if first.contact_states != {state}:
        page.get_by_role("button", name="Save contact states").click()
        page.get_by_text("Saved: ").wait_for()


def test_trial_action_and_variant_rerun_everything(paused: Page, dashboard: Dashboard, model: Path) -> None:
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
    own = after(dashboard, lambda: choose(page, "Variant", "v4"), 1, 1)
    page.get_by_text("the first of its models is drawn").wait_for()
    assert not np.array_equal(own.inference.active_state, second.inference.active_state)
    strip = page.locator(".mv-states .mv-strip .mv-segment")
    eventually(lambda: strip.count() == 1 + np.count_nonzero(np.diff(own.inference.active_state)), "the strip follows")
    assert "robot ×" in scene_props(page, "/latent/caption")["text"]
    back = after(dashboard, lambda: choose(page, "Variant", "v3.1"), 1, 1)
    assert np.array_equal(back.inference.active_state, second.inference.active_state)
    assert back.contact_states == load_checkpoint(model).contact_states_of("v3.1", "handshake"), "as it is stored"
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
    after(dashboard, lambda: slide(page, "Ellipsoid σ", "3"), 0, 0)
    eventually(lambda: (canvas(page) != before).any(), "the ellipsoids grow")
    after(dashboard, lambda: slide(page, "Ellipsoid σ", "2"), 0, 0)
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


def test_two_axes_swap(paused: Page, dashboard: Dashboard) -> None:
    page = paused
    tab(page, "View")
    after(dashboard, lambda: choose(page, "Latent axes", "dimensions"), 0, 0)
    after(dashboard, lambda: choose(page, "Axis y", "z0"), 0, 0)
    assert dashboard.session.choice is not None and dashboard.session.choice.view.latent_axes == (1, 0, 2)
    assert row(page, "Axis x").get_by_role("combobox").input_value() == "z1"
    after(dashboard, lambda: choose(page, "Axis x", "z0"), 0, 0)
    assert dashboard.session.choice.view.latent_axes == (0, 1, 2)
    after(dashboard, lambda: choose(page, "Latent axes", "principal components"), 0, 0)


def test_values_that_no_widget_offers_are_refused(paused: Page, dashboard: Dashboard) -> None:
    """viser takes whatever a websocket sends: the session must not."""
    page = paused
    tab(page, "Robot")
    good = shown(dashboard)
    send = "([uuid, value]) => window.__viserMutable.sendMessage({type: 'GuiUpdateMessage', uuid, updates: {value}})"
    by_label = {label: uuid for label, (uuid, _) in widgets(dashboard).items()}
    page.evaluate(send, [by_label["Controller"], "rm -rf"])
    page.locator(".mv-error", has_text="Controller 'rm -rf' is unknown").wait_for()
    page.locator(".mantine-Notification-root", has_text="could not be done").wait_for()  # one, in a message of its own
    assert "Controller 'rm -rf' is unknown; valid: base-ik, mild, mild-ik" in str(dashboard.session.error)
    assert shown(dashboard) is good
    after(dashboard, lambda: choose(page, "Controller", "mild"), 0, 1)
    eventually(lambda: page.locator(".mv-error").count() == 0, "the message goes away")
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
