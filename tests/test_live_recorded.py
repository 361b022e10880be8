"""A recorded session on the page of playback: exactly as it was, and otherwise when asked for."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_live_session import demo_model, run

from mild_viz import pipeline
from mild_viz.cli import main
from mild_viz.dashboard.app import Dashboard, open_dashboard
from mild_viz.dashboard.live.recorded import open_recorded
from mild_viz.dashboard.server import free_port
from mild_viz.live.config import LiveConfig
from mild_viz.live.replayed import interactions
from mild_viz.paths import default_checkpoint
from mild_viz.robot.control.rules import JUMPED
from mild_viz.settings import Placement, Watch

HOST = "127.0.0.1"
STATES = frozenset({1, 4})


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sessions") / "session.jsonl"
    config = replace(LiveConfig(), max_speed=1.0)  # slower than a reach: the jump rule fires
    place = Placement(0.7, 0.1, 0.2)
    run(demo_model(config=config, lambda_q=0.1, smoothing=0.6, placement=place, contact_states=STATES), path, (4, 4))
    return path


@pytest.fixture(scope="module")
def dashboard(session: Path) -> Iterator[Dashboard]:
    port = free_port(HOST, 18_300)
    assert port is not None
    dashboard = open_dashboard(session=session, port=port)
    assert dashboard.session.wait_idle() and dashboard.session.error is None
    yield dashboard
    for thread in threading.enumerate():
        if thread.name == "mild_viz datasets":  # it completes the list of datasets in the page: not after its end
            thread.join()
    dashboard.stop()


def sent(session: Path, number: int) -> np.ndarray:
    recorded = open_recorded(session)
    return np.array([tick.sent.positions for tick in interactions(recorded.session)[number] if tick.sent is not None])


def test_the_page_shows_what_was_sent_until_settings_change(dashboard: Dashboard, session: Path) -> None:
    page = dashboard.session
    assert page.rollout is not None and page.choice is not None
    np.testing.assert_array_equal(page.rollout.joints_commanded, sent(session, 1))
    assert page.rollout.inference.dataset == "session, as recorded"
    control = page.choice.settings.control
    assert (control.lambda_q, control.smoothing) == (0.1, 0.6), "the widgets say what was recorded"
    assert control.contact_states == page.rollout.contact_states == STATES
    assert (
        page.choice.trial.name == "session/test/0"
        and len(dashboard.controls._catalog.trials("session", "handshake")) == 2
    )

    tab = dashboard.controls._robot
    tab._controller.value = "mild"
    page.mark_dirty()
    assert page.wait_idle() and page.error is None
    assert page.rollout.controller == "mild" and page.rollout.inference.dataset == "session"
    assert page.rollout.inference.n_windows != len(sent(session, 1)), "a row for every frame again"
    inference, choice, recorded = page.rollout.inference, page.choice, open_recorded(session).settings
    expected = pipeline.control(
        inference, choice.checkpoint, choice.robot, choice.trial, replace(recorded, controller="mild")
    )
    np.testing.assert_array_equal(page.rollout.joints_commanded, expected.joints_commanded)
    np.testing.assert_array_equal(page.rollout.target, expected.target)
    assert (page.rollout.fired == expected.fired).all() and (expected.fired & 1 << JUMPED).any()
    assert page.rollout.placement == recorded.placement and page.rollout.contact_states == STATES
    tab._controller.value = "mild-ik"
    page.mark_dirty()
    assert page.wait_idle() and page.error is None
    np.testing.assert_array_equal(page.rollout.joints_commanded, sent(session, 1))


def test_the_first_settings_stand_for_the_recorded_ones_whatever_variant_they_come_with(session: Path) -> None:
    recorded = open_recorded(session)
    checkpoint, robot, trial = recorded.checkpoint, recorded.robot, recorded.dataset.test[0]
    states = checkpoint.contact_states_of("v4", "handshake")
    read = replace(recorded.settings, watch=Watch(), placement=None)  # as the widgets do
    for variant, settings, name in (
        ("v4", replace(read, contact_states=states), "session"),
        ("v3.1", replace(read, smoothing=1.0), "session"),
        ("v3.1", read, "session, as recorded"),
    ):
        inference = recorded.infer(checkpoint, trial, variant, robot)
        rollout = recorded.control(inference, checkpoint, robot, trial, settings)
        assert rollout.inference.dataset == name, (variant, settings)


def test_the_other_interaction_can_be_chosen(dashboard: Dashboard, session: Path) -> None:
    tab = dashboard.controls._trial
    tab._trial.value = "test 1"
    dashboard.session.mark_dirty()
    assert dashboard.session.wait_idle() and dashboard.session.error is None
    assert dashboard.session.rollout is not None
    np.testing.assert_array_equal(dashboard.session.rollout.joints_commanded, sent(session, 2))


def test_a_session_that_cannot_be_shown_is_refused(
    session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = tmp_path / "damaged.jsonl"
    damaged.write_bytes(session.read_bytes().replace(b'"tick"', b'"tock"', 1))
    for options, message in (
        (("--session", str(damaged)), "line 2 is damaged"),
        (("--session", str(tmp_path / "none.jsonl")), "cannot be read"),
        (("--session", str(session), "--checkpoint", str(default_checkpoint("nuisi"))), "recorded with another model"),
    ):
        assert main(["app", "--port", "18399", *options]) == 2
        assert message in capsys.readouterr().err
