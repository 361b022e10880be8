"""What the header and the line over the charts say of one moment, and of the whole trial."""

from __future__ import annotations

import numpy as np
from dashboard_fakes import make_inference, make_rollout

from mild_viz.dashboard.controls import header_html, now_html
from mild_viz.dashboard.tabs.view import swapped
from mild_viz.dashboard.timeline import _now
from mild_viz.robot.control.rules import IN_CONTACT, VELOCITY


def test_state_stiffness_and_distance() -> None:
    stiffness = np.ones((60, 4))
    stiffness[30, 2] = 0.4
    rollout = make_rollout(make_inference(), stiffness=stiffness, hand_distance=np.full(60, 0.123))
    for text in (now_html(rollout, 30), _now(rollout, 30)):
        assert "state <b>1</b> · contact state" in text and "stiffness 40 %" in text
        assert "robot hand to wrist" in text and "12.3 cm" in text
    assert "free motion" in now_html(rollout, 0) and "stiffness 100 %" in now_html(rollout, 0)


def test_the_rules_that_fired_are_named() -> None:
    fired = np.zeros(60, dtype=np.int64)
    fired[30] = 1 << IN_CONTACT | 1 << VELOCITY
    rollout = make_rollout(make_inference(), fired=fired)
    assert "rules: contact, velocity</div>" in now_html(rollout, 30)
    assert "rules: none</div>" in now_html(rollout, 29)


def test_no_distance_where_tracking_was_lost() -> None:
    tracked = np.ones(60, dtype=bool)
    tracked[10] = False
    rollout = make_rollout(make_inference(tracked=tracked))
    for text in (now_html(rollout, 10), _now(rollout, 10)):
        assert "tracking lost" in text and " cm" not in text
    assert "tracking lost" not in now_html(rollout, 11)


def test_the_distance_is_no_headline_where_nobody_touches() -> None:
    assert "<b>50.0 cm</b>" in now_html(make_rollout(make_inference()), 0)
    wave = now_html(make_rollout(make_inference(action="wave")), 0)
    assert "50.0 cm" in wave and "<b>50.0 cm</b>" not in wave


def test_the_error_belongs_to_the_variant_not_to_the_controller() -> None:
    text = header_html(make_rollout(make_inference()), "a model's name")
    assert "variant v3.1, MSE of the decoded motion (before IK) <b>0.0200 rad²</b>" in text
    assert "model a model&#x27;s name, controller mild-ik<br>" in text


def test_an_axis_swaps_with_the_one_that_had_its_dimension() -> None:
    assert swapped(["z0", "z1", "z2"], ["z2", "z1", "z2"]) == ["z2", "z1", "z0"]
    assert swapped(["z0", "z1", "z2"], ["z3", "z1", "z2"]) == ["z3", "z1", "z2"]
    assert swapped(["z0", "z1", "z2"], ["z2", "z2", "z2"]) == ["z1", "z2", "z0"]
