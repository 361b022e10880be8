"""Contact rules as data: read strictly, kept in the checkpoint, obeyed by the controller, and seen when they fire."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mild_viz.checkpoint import load_checkpoint, save_checkpoint
from mild_viz.checkpoint.config import config_of
from mild_viz.errors import UserError
from mild_viz.latent.transition import TransitionState
from mild_viz.paths import checkpoints
from mild_viz.pipeline import uses_transition
from mild_viz.robot.control import rules
from mild_viz.robot.control.controller import Controller, ControlResult, make_controller
from mild_viz.robot.control.rules import DEFAULT_RULES, RULES, ContactRules, fired_rules, parse_contact_rules
from mild_viz.robot.control.stiffness import stiffness_schedule
from mild_viz.robot.ik import forward
from mild_viz.robot.model import load_robot
from mild_viz.robot.spec import StiffnessSpec
from mild_viz.settings import ControlSettings
from mild_viz.trial import ACTIONS
from tests.controllers import LOW, RATE, frames
from tests.models import random_checkpoint

ROBOT = load_robot("pepper")
REACH, TOUCH, AWAY = 0, 1, 2
NEAR = forward(ROBOT.chain, np.array([[0.3, -0.2, 1.0, 0.7]]))[0]


# reading and keeping


def test_every_shipped_model_says_how_it_behaves_in_contact() -> None:
    shipped = sorted(path for path in checkpoints().iterdir() if path.is_dir())
    assert len(shipped) >= 6
    for path in shipped:
        model = load_checkpoint(path)
        assert set(model.contact_rules) == set(model.actions)
        written, meant = json.loads((path / "config.json").read_text()), json.loads(json.dumps(config_of(model)))
        assert written["contact_rules"] == meant["contact_rules"]
        for action in model.actions:
            assert model.contact_rules_of(action).compliant == (action == "handshake")


def test_rules_are_saved_and_loaded(tmp_path: Path) -> None:
    own = ContactRules(compliant=True, stiffness=0.2, stiffness_fall=5.0, ik="crossed", ik_doubt=0.6)
    model = replace(random_checkpoint(), contact_rules={"rocket": own})
    loaded = save_checkpoint(model, tmp_path / "model", "# model\n")
    assert loaded.contact_rules == {"rocket": own} and loaded.contact_rules_of("rocket") == own
    assert loaded.contact_rules_of("handshake") == DEFAULT_RULES["handshake"]
    file = tmp_path / "model" / "config.json"
    config = json.loads(file.read_text())
    assert config["contact_rules"] == {"rocket": asdict(own)}
    del config["contact_rules"]  # as models from before
    file.write_text(json.dumps(config))
    assert load_checkpoint(tmp_path / "model").contact_rules_of("rocket") == DEFAULT_RULES["rocket"]
    config["contact_rules"] = {"rocket": {"stifness": 0.2}}
    file.write_text(json.dumps(config))
    with pytest.raises(UserError, match=r"config.json: contact_rules: rocket: 'stifness' is unknown; valid: compliant"):
        load_checkpoint(tmp_path / "model")


def test_what_is_not_said_is_the_actions_default() -> None:
    assert set(DEFAULT_RULES) == set(ACTIONS)
    parsed = parse_contact_rules({"handshake": {"stiffness": 0.3}, "rocket": {}}, ACTIONS, "x")
    assert parsed == {
        "handshake": replace(DEFAULT_RULES["handshake"], stiffness=0.3),
        "rocket": DEFAULT_RULES["rocket"],
    }


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], r"x is \[\], expected an object"),
        ({"hug": {}}, "x: action 'hug' is unknown; valid: wave, handshake"),
        ({"wave": 3}, "x: wave is 3, expected an object"),
        ({"wave": {"compliant": 1}}, "x: wave.compliant is 1, expected true or false"),
        ({"wave": {"stiffness": True}}, "x: wave.stiffness is True, expected a number"),
        ({"wave": {"stiffness": "low"}}, "x: wave.stiffness is 'low', expected a number"),
        ({"wave": {"stiffness": 1.5}}, "x: wave.stiffness is 1.5; valid: 0 to 1"),
        ({"wave": {"stiffness_rise": 0}}, "x: wave.stiffness_rise is 0.0; valid: 0.001 to 1000"),
        ({"wave": {"ik_doubt": float("nan")}}, "x: wave.ik_doubt is nan; valid: 0 to 1"),
        ({"wave": {"ik": "always"}}, "x: wave.ik 'always' is unknown; valid: contact, crossed"),
        ({"wave": {"ik": None}}, "x: wave.ik is None, expected a text"),
    ],
)
def test_bad_rules_are_refused(content: Any, message: str) -> None:
    with pytest.raises(UserError, match=message):
        parse_contact_rules(content, ACTIONS, "x")


# obeying


def controller(rule: ContactRules, name: str = "mild-ik", **changes: Any) -> Controller:
    chosen = replace(ControlSettings(controller=name, contact_states=frozenset({TOUCH})), **changes)
    return make_controller(ROBOT, chosen, rule, 3, RATE)


def visits(*runs: tuple[int, int], share: float = 0.9, second: int | None = None) -> np.ndarray:
    """States one after the other, each the most likely with this share; `second` is the next most likely."""
    states = np.concatenate([np.full(steps, state) for state, steps in runs])
    log_alpha = np.full((len(states), 3), np.log((1.0 - share) / 2))
    if second is not None:
        log_alpha[:, second] = np.log((1.0 - share) * 0.7)
    log_alpha[np.arange(len(states)), states] = np.log(share)
    return log_alpha


def run(used: Controller, log_alpha: np.ndarray, log_transition: np.ndarray | None = None) -> ControlResult:
    n = len(log_alpha)
    decoded = np.tile([0.4, -0.3, 1.0, 0.7], (n, 1))
    return used.run(frames(log_alpha, decoded, np.tile(NEAR, (n, 1)), log_transition), used.start())


def fired(result: ControlResult, number: int) -> list[int]:
    return np.flatnonzero((result.fired >> number) & 1).tolist()


def test_stiffness_goes_down_into_contact_and_up_after_it_at_its_rates() -> None:
    rule = DEFAULT_RULES["handshake"]
    result = run(controller(rule), visits((REACH, 20), (TOUCH, 20), (AWAY, 40)))
    level = result.stiffness[:, 0]
    assert (level[:20] == 1.0).all() and (result.stiffness == level[:, None]).all()
    fall = np.maximum(1.0 - rule.stiffness_fall / RATE * np.arange(1, 21), LOW)
    np.testing.assert_allclose(level[20:40], fall)
    rise = np.minimum(LOW + rule.stiffness_rise / RATE * np.arange(1, 41), 1.0)
    np.testing.assert_allclose(level[40:], rise)
    assert fired(result, rules.SOFT) == list(range(20, 40))
    # 0.6 down at 3 a second: 6 frames; 0.6 up at 0.6 a second: 30, of which the last one arrives
    assert fired(result, rules.RAMPING) == [*range(20, 25), *range(40, 69)]


def test_a_compliant_contact_that_is_switched_off_stays_stiff() -> None:
    log_alpha = visits((REACH, 5), (TOUCH, 10))
    for used in (controller(DEFAULT_RULES["rocket"]), controller(DEFAULT_RULES["handshake"], stiffness=False)):
        result = run(used, log_alpha)
        assert (result.stiffness == 1.0).all() and fired(result, rules.SOFT) == []


def test_the_robot_bounds_the_stiffness_and_its_rate() -> None:
    rule = ContactRules(compliant=True, stiffness=0.1, stiffness_fall=50.0)
    assert stiffness_schedule(rule, True, StiffnessSpec()) == (1.0, 0.1, 10.0, 0.6)
    bounded = stiffness_schedule(rule, True, StiffnessSpec(lowest=0.3, highest=0.8, rate=0.5))
    assert bounded == (0.8, 0.3, 0.5, 0.5)
    used = replace(controller(rule), stiffness=StiffnessSpec(0.3, 0.8, 0.5))
    level = run(used, visits((REACH, 5), (TOUCH, 60))).stiffness[:, 0]
    assert level[0] == 0.8 and level[-1] == pytest.approx(0.3) and np.diff(level).min() >= -0.5 / RATE - 1e-12


def test_back_transitions_are_blocked_where_the_rules_say_so() -> None:
    log_alpha = visits((REACH, 5), (TOUCH, 15), (REACH, 5), second=TOUCH)
    blocked = run(controller(DEFAULT_RULES["handshake"]), log_alpha)
    assert fired(blocked, rules.NO_RETURN) == list(range(20, 25)) and fired(blocked, rules.SOFT)[-1] == 24
    free = run(controller(replace(DEFAULT_RULES["handshake"], no_back_transition=False)), log_alpha)
    assert fired(free, rules.NO_RETURN) == [] and fired(free, rules.SOFT)[-1] == 19


def test_the_transition_state_counts_where_the_rules_say_so() -> None:
    states = frozenset({TOUCH})
    known = TransitionState(np.zeros(2), np.eye(2), 0.1, states)
    chosen, other = ControlSettings(contact_states=states), ControlSettings(contact_states=frozenset({AWAY}))
    says, silent = DEFAULT_RULES["handshake"], replace(DEFAULT_RULES["handshake"], transition_state=False)
    cases = [(chosen, says, known), (chosen, silent, known), (other, says, known), (chosen, says, None)]
    assert [uses_transition(*case) for case in cases] == [True, False, False, False]


def test_the_transition_state_begins_contact() -> None:
    log_alpha, log_transition = visits((REACH, 10), (TOUCH, 5), second=TOUCH), np.full(15, -np.inf)
    log_transition[6] = np.log(0.7)
    rule = DEFAULT_RULES["handshake"]
    result = run(controller(rule), log_alpha, log_transition)
    assert fired(result, rules.CROSSED) == [6] and fired(result, rules.SOFT) == list(range(6, 15))
    assert fired(result, rules.BY_IK) == list(range(10, 15)) == fired(result, rules.IN_CONTACT)
    without = run(controller(rule), log_alpha, np.full(15, -np.inf))
    assert fired(without, rules.CROSSED) == [] and fired(without, rules.SOFT) == list(range(10, 15))


def test_ik_of_the_authors_handshake_begins_with_the_transition_and_stays() -> None:
    log_alpha, log_transition = visits((REACH, 10), (TOUCH, 5), (AWAY, 5), second=TOUCH), np.full(20, -np.inf)
    log_transition[6] = np.log(0.7)
    result = run(controller(replace(DEFAULT_RULES["handshake"], ik="crossed")), log_alpha, log_transition)
    assert fired(result, rules.BY_IK) == list(range(6, 20))
    assert np.flatnonzero(result.contact).tolist() == list(range(10, 15))


def test_ik_of_the_authors_rocket_begins_in_doubt() -> None:
    log_alpha = np.concatenate([visits((REACH, 5)), visits((REACH, 3), share=0.55), visits((TOUCH, 4))])
    result = run(controller(replace(DEFAULT_RULES["rocket"], ik_doubt=0.6)), log_alpha)
    assert fired(result, rules.IN_DOUBT) == [5, 6, 7] and fired(result, rules.BY_IK) == list(range(5, 12))
    plain = run(controller(DEFAULT_RULES["rocket"]), log_alpha)
    assert fired(plain, rules.IN_DOUBT) == [] and fired(plain, rules.BY_IK) == list(range(8, 12))
    # an action without contact has nothing to be in doubt about
    none = controller(replace(DEFAULT_RULES["rocket"], ik_doubt=0.6), contact_states=frozenset())
    assert fired(run(none, log_alpha), rules.BY_IK) == []


def test_a_hand_beyond_reach_is_told() -> None:
    used, log_alpha = controller(DEFAULT_RULES["rocket"], "base-ik"), visits((REACH, 40))
    far = ROBOT.chain.shoulder + 1.5 * ROBOT.chain.reach * np.array([1.0, 0.0, 0.0])
    near = run(used, log_alpha)
    away = used.run(frames(log_alpha, np.zeros((40, 4)), np.tile(far, (40, 1))), used.start())
    assert fired(near, rules.OUT_OF_REACH) == [] and fired(near, rules.BY_IK) == list(range(40))
    assert fired(away, rules.OUT_OF_REACH) == list(range(40))
    stretched = np.linalg.norm(forward(ROBOT.chain, away.joints[-1:])[0] - ROBOT.chain.shoulder)
    assert stretched > 0.99 * ROBOT.chain.reach


# seeing


def test_rules_have_names_and_sentences_for_people() -> None:
    assert len({rule.name for rule in RULES}) == len(RULES) <= 62
    for rule in RULES:
        assert rule.name == rule.name.lower() and rule.text[0].isupper() and rule.text.endswith(".")
    assert [rule.name for rule in fired_rules(1 << rules.IN_CONTACT | 1 << rules.GONE)] == ["contact", "gone"]
    assert [rule.name for rule in RULES if not rule.safety][-1] == "ramp"


@pytest.mark.parametrize("edit", [lambda used: replace(used, n_states=2), lambda used: replace(used, n_states=63)])
def test_states_that_do_not_fit_are_refused(edit: Callable[[Controller], Controller]) -> None:
    used = edit(controller(DEFAULT_RULES["rocket"], contact_states=frozenset({2})))
    with pytest.raises(UserError, match="contact state 2 is unknown; valid: 0 to 1|takes up to 62"):
        used.run(frames(visits((REACH, 1)), np.zeros((1, 4)), NEAR[None]), used.start())
