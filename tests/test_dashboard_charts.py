"""The charts are pictures of fields of the rollout: well-formed, at the right place, broken where data is missing."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from dashboard_fakes import make_inference, make_rollout

from mild_viz.dashboard import charts
from mild_viz.robot.control.rules import BY_IK, IN_CONTACT, RULES, VELOCITY
from mild_viz.settings import STATE_COLORS


def parse(html: str) -> ElementTree.Element:
    return ElementTree.fromstring(html)


def segments(lane: ElementTree.Element, css: str) -> list[tuple[float, float, str]]:
    """Left edge, width [%] and colour of a strip's segments."""
    (strip,) = (node for node in lane.iter("div") if node.get("class") == css)
    found = []
    for node in strip:
        style = dict(item.split(":", 1) for item in str(node.get("style")).split(";"))
        found.append((float(style["left"][:-1]), float(style["width"][:-1]), style["background"]))
    return found


def points(line: ElementTree.Element) -> np.ndarray:
    return np.array(str(line.get("points")).split(), dtype=float).reshape(-1, 2)


def test_every_lane_is_well_formed_and_has_a_cursor() -> None:
    lanes = charts.draw_lanes(make_rollout(make_inference()), "human")
    assert tuple(lanes) == charts.LANES
    for name, html in lanes.items():
        lane = parse(html)
        assert "mv-lane" in str(lane.get("class"))
        assert name == "axis" or 'class="mv-cursor"' in html


def test_the_strip_shows_the_active_state_over_the_whole_trial() -> None:
    rollout = make_rollout(make_inference(n=60, n_states=3))
    strip = segments(parse(charts.draw_lanes(rollout, "human")["states"]), "mv-strip")
    assert [color for _, _, color in strip] == list(STATE_COLORS[:3])
    assert sum(width for _, width, _ in strip) == pytest.approx(100.0, abs=0.05)
    assert strip[1][0] == pytest.approx(100 * 19.5 / 59, abs=0.01), "the border lies half way between rows 19 and 20"
    contact = segments(parse(charts.draw_lanes(rollout, "human")["states"]), "mv-contact")
    assert contact[1] == (strip[1][0], strip[1][1], "var(--mantine-color-text)")


def test_true_phases_are_a_second_strip_only_where_they_are_known() -> None:
    inference = make_inference(n=40)
    assert "mv-phase" not in charts.draw_lanes(make_rollout(inference), "human")["states"]
    inference = make_inference(n=40, phase=np.repeat([0, 1, 2, 3], 10))
    html = charts.draw_lanes(make_rollout(inference), "human")["states"]
    assert len(segments(parse(html), "mv-phase")) == 4
    assert all(name in html for name in ("reach", "contact", "return"))


def test_rules_are_two_strips_that_say_on_hover_what_fired() -> None:
    fired = np.zeros(60, dtype=np.int64)
    fired[20:40] = 1 << IN_CONTACT
    fired[30:40] |= 1 << BY_IK
    fired[35:38] |= 1 << VELOCITY
    lane = parse(charts.draw_lanes(make_rollout(make_inference(n=60), fired=fired), "human")["rules"])
    contact, safety = segments(lane, "mv-strip"), segments(lane, "mv-safety")
    assert [color != "transparent" for _, _, color in contact] == [False, True, True, False]
    assert contact[1][0] == pytest.approx(100 * 19.5 / 59, abs=0.01)
    assert [color != "transparent" for _, _, color in safety] == [False, True, False]
    assert safety[1][2] != contact[1][2], "the safety filter's rules have a colour of their own"
    hints = [str(node.get("title")) for node in lane.iter("div") if node.get("class") == "mv-segment"]
    both = next(hint for hint in hints if hint.startswith("contact:") and "ik:" in hint)
    assert RULES[IN_CONTACT].text in both and RULES[BY_IK].text in both and "\n" in both
    assert RULES[VELOCITY].text not in both
    assert any(hint.startswith(f"velocity: {RULES[VELOCITY].text}") for hint in hints)


def test_who_waves_is_not_in_contact() -> None:
    inference = make_inference(n=40, phase=np.repeat([0, 1, 2, 3], 10), action="wave")
    html = charts.draw_lanes(make_rollout(inference), "human")["states"]
    assert "waving" in html and ">contact<" not in html


def test_stiffness_is_drawn_where_it_varies() -> None:
    inference = make_inference(n=60)
    assert "stiffness" not in charts.draw_lanes(make_rollout(inference), "human")["distance"]
    stiffness = np.ones((60, 4))
    stiffness[20:40] = 0.4
    html = charts.draw_lanes(make_rollout(inference, stiffness=stiffness), "human")["distance"]
    (line,) = (node for node in parse(html).iter("polyline") if node.get("class") == "mv-stiffness")
    assert points(line)[30, 1] == pytest.approx((1 - 0.4 / 1.06) * charts.HEIGHT, abs=0.6)


def test_alpha_follows_the_chosen_mode() -> None:
    other = np.log(np.tile([0.2, 0.3, 0.5], (60, 1)))
    inference = make_inference(n=60, log_alpha_unobserved=other)
    lanes = {mode: charts.draw_lanes(make_rollout(inference), mode)["alpha"] for mode in ("human", "unobserved")}
    lines = list(parse(lanes["unobserved"]).iter("polyline"))
    assert [line.get("style") for line in lines] == [f"stroke:{color}" for color in STATE_COLORS[:3]]
    assert points(lines[2])[:, 1] == pytest.approx((1.03 - 0.5) / 1.06 * charts.HEIGHT, abs=0.6)
    assert lanes["human"] != lanes["unobserved"] and ">unobserved<" in lanes["unobserved"]


def test_rows_lie_at_the_same_place_in_every_lane() -> None:
    rollout = make_rollout(make_inference(n=61))
    for name in ("alpha", "joints", "distance"):
        line = next(parse(charts.draw_lanes(rollout, "human")[name]).iter("polyline"))
        x = points(line)[:, 0]
        assert x[0] == 0 and x[-1] == charts.WIDTH and x[30] == charts.WIDTH / 2


def test_curves_are_broken_where_data_is_missing() -> None:
    truth = np.ones((60, 4))
    truth[20:30, 1] = np.nan
    truth[:, 2] = np.nan
    tracked = np.ones(60, dtype=bool)
    tracked[10:20] = False
    html = charts.draw_lanes(make_rollout(make_inference(n=60, joints_truth=truth, tracked=tracked)), "human")
    rows = [node for node in parse(html["joints"]).iter("div") if node.get("class") == "mv-row"]
    curves = [[line for line in row.iter("polyline") if line.get("class") == "mv-truth"] for row in rows]
    assert [len(lines) for lines in curves] == [1, 2, 0, 1]
    assert "nan" not in html["joints"].lower()
    assert html["alpha"].count("mv-lost") == html["distance"].count("mv-lost") == 1
    assert "tracking lost" in html["joints"]
    before, later = (points(line) for line in parse(html["distance"]).iter("polyline"))
    assert (before[-1, 0], later[0, 0]) == (round(9 / 59 * charts.WIDTH), round(20 / 59 * charts.WIDTH))


def test_a_trial_without_any_truth_or_motion_still_draws() -> None:
    nothing = make_inference(n=1, joints_truth=np.full((1, 4), np.nan), joints_decoded=np.zeros((1, 4)))
    for html in charts.draw_lanes(make_rollout(nothing, hand_distance=np.array([np.nan])), "human").values():
        parse(html)
        assert "nan" not in re.sub(r"[a-z]+nan[a-z]+", "", html.lower())


def test_long_trials_stay_small() -> None:
    lanes = charts.draw_lanes(make_rollout(make_inference(n=20_000)), "human")
    assert sum(map(len, lanes.values())) < 250_000


def test_only_the_lanes_that_depend_on_the_control_change_with_it() -> None:
    inference = make_inference()
    first = charts.draw_lanes(make_rollout(inference), "human")
    second = charts.draw_lanes(make_rollout(inference, joints_commanded=inference.joints_decoded), "human")
    assert [name for name in charts.LANES if first[name] != second[name]] == ["joints"]


def test_names_from_a_robot_description_are_escaped() -> None:
    names = ("<script>alert(1)</script>", "a&b", "c", "d")
    html = charts.draw_lanes(make_rollout(make_inference(joint_names=names)), "human")["joints"]
    assert "<script>" not in html and "&lt;script&gt;" in html


@pytest.mark.parametrize(("start", "end"), [(0.0, 0.4), (0.13, 5.0), (0.13, 17.0), (0.0, 700.0), (1.0, 1.0)])
def test_marks_of_the_time_axis(start: float, end: float) -> None:
    marks = charts.tick_times(start, end)
    assert len(marks) <= 9 and all(start - 1e-9 <= t <= end + 1e-9 for t in marks)
    assert len(marks) >= 2 or end == start
    assert np.allclose(np.diff(marks, 2), 0.0)


def test_cursor() -> None:
    assert charts.cursor_html(0.25) == "<style>.mv-lane{--mv-time:25.00}</style>"


def test_numbers_can_be_read_on_every_state_colour() -> None:
    assert charts.text_color("#F0E442") == "#000" and charts.text_color("#0072B2") == "#fff"
