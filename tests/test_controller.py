"""Gating, IK, smoothing, limits and stiffness: against a plain loop, and streaming against batch."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from mild_viz.errors import UserError
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.control.controller import ControlCarry, Controller, make_controller, state_mask
from mild_viz.robot.control.rules import DEFAULT_RULES
from mild_viz.robot.ik import forward, solve_ik
from mild_viz.robot.model import load_robot
from mild_viz.settings import CONTROLLERS_OF, ControlSettings
from tests.controllers import LOW, RATE, cut, frames, unhindered

ROBOT = load_robot("pepper")
CHAIN = ROBOT.chain
N, STATES = 430, 6
CONTACT = frozenset({2, 3})


@pytest.fixture(scope="module")
def interaction() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forward variable, decoded joints (some beyond the limits) and the human's hand (some missing)."""
    random = np.random.default_rng(5)
    share = np.linspace(0.0, 1.0, N)[:, None]
    centers = np.linspace(0.0, 1.0, STATES)
    log_alpha = -(((share - centers) / 0.12) ** 2) + random.normal(scale=2.0, size=(N, STATES))
    log_alpha -= np.log(np.exp(log_alpha).sum(axis=1, keepdims=True))
    middle, width = (CHAIN.upper + CHAIN.lower) / 2, (CHAIN.upper - CHAIN.lower) / 2
    decoded = middle + 1.1 * width * np.sin(5.0 * share + np.arange(4))
    targets = forward(CHAIN, np.clip(decoded, CHAIN.lower, CHAIN.upper)) + random.normal(scale=0.05, size=(N, 3))
    targets[100:110] = np.nan
    targets[200, 1] = np.nan
    return log_alpha, decoded, targets


def run(interaction, settings: ControlSettings, action: str = "handshake"):
    controller = unhindered(CHAIN, settings, action, STATES)
    return controller.run(frames(*interaction), controller.start())


def plain_loop(chain: ArmChain, settings: ControlSettings, action: str, log_alpha, decoded, targets):
    """The same as the compiled loop, written for reading."""
    contact_states = settings.contact_states or frozenset()
    previous, joints, contact, stiffness = None, [], [], []
    visited, touched = set(), False
    for row, prior, target in zip(log_alpha, decoded, targets, strict=True):
        active = int(np.argmax(row))
        in_contact = active in contact_states
        seen = bool(np.isfinite(target).all())
        new = np.clip(prior, chain.lower, chain.upper)
        if settings.controller == "base-ik":
            new = chain.rest if previous is None else previous
            if seen:
                new = solve_ik(chain, target[None], new[None], settings.lambda_x, 1e-3 * settings.lambda_x)[0]
        elif settings.controller == "mild-ik" and in_contact and seen:
            new = solve_ik(chain, target[None], prior[None], settings.lambda_x, settings.lambda_q)[0]
        if previous is not None:
            new = settings.smoothing * new + (1.0 - settings.smoothing) * previous
        previous = new
        if in_contact:
            touched = True
        elif not touched:
            visited.add(active)
        masked = [value if state not in visited else -np.inf for state, value in enumerate(row)]
        soft = touched and int(np.argmax(masked)) in contact_states
        lowered = soft and settings.stiffness and action == "handshake"
        joints.append(new)
        contact.append(in_contact)
        stiffness.append(np.full(chain.n_joints, LOW if lowered else 1.0))
    return np.array(joints), np.array(contact), np.array(stiffness)


@pytest.mark.parametrize("controller", CONTROLLERS_OF["joints"])
@pytest.mark.parametrize("action", ["handshake", "rocket"])
@pytest.mark.parametrize("smoothing", [0.8, 1.0])
def test_equals_a_plain_loop(interaction, controller, action, smoothing):
    settings = ControlSettings(controller=controller, contact_states=CONTACT, smoothing=smoothing)
    result = run(interaction, settings, action)
    joints, contact, stiffness = plain_loop(CHAIN, settings, action, *interaction)
    np.testing.assert_allclose(result.joints, joints, atol=1e-9)
    np.testing.assert_array_equal(result.contact, contact)
    np.testing.assert_array_equal(result.stiffness, stiffness)


def own(settings: ControlSettings, action: str = "handshake") -> Controller:
    """With the arm's own limits."""
    return make_controller(ROBOT, settings, DEFAULT_RULES[action], STATES, RATE)


@pytest.mark.parametrize("controller", CONTROLLERS_OF["joints"])
def test_streaming_equals_batch_bit_for_bit(interaction, controller):
    used, whole = own(ControlSettings(controller=controller, contact_states=CONTACT)), frames(*interaction)
    batch = used.run(whole, used.start())
    for size in (1, 7):
        carry, parts = used.start(), []
        for begin in range(0, N, size):
            parts.append(used.run(cut(whole, slice(begin, begin + size)), carry))
            carry = parts[-1].carry
        for field in ("joints", "contact", "stiffness", "fired"):
            np.testing.assert_array_equal(
                np.concatenate([getattr(part, field) for part in parts]), getattr(batch, field)
            )
        for field in ControlCarry._fields:
            np.testing.assert_array_equal(getattr(carry, field), getattr(batch.carry, field))


def test_the_given_carry_is_not_changed(interaction):
    used = own(ControlSettings(contact_states=CONTACT))
    carry, before = used.start(), used.start()
    used.run(frames(*interaction), carry)
    for field in ControlCarry._fields:
        np.testing.assert_array_equal(getattr(carry, field), getattr(before, field))


def test_ik_works_only_in_contact_and_brings_the_hand_closer(interaction):
    _, decoded, targets = interaction
    plain = run(interaction, ControlSettings(controller="mild", contact_states=CONTACT, smoothing=1.0))
    adapted = run(interaction, ControlSettings(controller="mild-ik", contact_states=CONTACT, smoothing=1.0))
    inside = np.clip(decoded, CHAIN.lower, CHAIN.upper)
    np.testing.assert_allclose(plain.joints, inside)
    np.testing.assert_allclose(adapted.joints[~adapted.contact], inside[~adapted.contact])
    seen = adapted.contact & np.isfinite(targets).all(axis=1)

    def distance(joints: np.ndarray) -> np.ndarray:
        return np.linalg.norm(forward(CHAIN, joints[seen]) - targets[seen], axis=1)

    assert seen.sum() > 50
    assert np.all(distance(adapted.joints) <= distance(plain.joints) + 1e-9)
    assert distance(adapted.joints).mean() < 0.6 * distance(plain.joints).mean()


def test_base_ik_ignores_the_decoded_joints_and_starts_at_rest(interaction):
    log_alpha, decoded, targets = interaction
    settings = ControlSettings(controller="base-ik", smoothing=1.0)
    first = run((log_alpha, decoded, targets), settings)
    other = run((log_alpha, -decoded, targets), settings)
    np.testing.assert_array_equal(first.joints, other.joints)
    unseen = run((log_alpha, decoded, np.full_like(targets, np.nan)), settings)
    np.testing.assert_allclose(unseen.joints, np.tile(CHAIN.rest, (N, 1)))


# stiffness


def segments(*states: int) -> np.ndarray:
    """A forward variable in which these states are active, one after the other; the next likely is the last named."""
    log_alpha = np.full((len(states), STATES), -5.0)
    log_alpha[np.arange(len(states)), states] = -0.1
    return log_alpha


def stiffness_of(log_alpha: np.ndarray, action: str = "handshake", **changes) -> np.ndarray:
    settings = replace(ControlSettings(contact_states=CONTACT), **changes)
    rest = np.tile(CHAIN.rest, (len(log_alpha), 1))
    return run((log_alpha, rest, np.full((len(rest), 3), np.nan)), settings, action).stiffness[:, 0]


def test_stiffness_is_lowered_in_the_contact_of_a_handshake_only():
    visits = segments(0, 1, 2, 3, 2, 4, 5)
    np.testing.assert_array_equal(stiffness_of(visits), [1, 1, LOW, LOW, LOW, 1, 1])
    np.testing.assert_array_equal(stiffness_of(visits, stiffness=False), np.ones(7))
    for action in ("wave", "rocket", "parachute", "handover"):
        np.testing.assert_array_equal(stiffness_of(visits, action), np.ones(7))
    np.testing.assert_array_equal(stiffness_of(visits, contact_states=frozenset()), np.ones(7))


def test_no_back_transition_to_reaching():
    """A frame in contact that is mistaken for reaching does not stiffen the arm; the retreat does."""
    visits = segments(0, 1, 2, 1, 0, 3, 4)
    visits[3, 2] = visits[4, 3] = -1.0  # the second most likely state is one of contact
    np.testing.assert_array_equal(stiffness_of(visits), [1, 1, LOW, LOW, LOW, LOW, 1])
    # before the first contact nothing is masked
    np.testing.assert_array_equal(stiffness_of(segments(0, 1, 0, 1)), np.ones(4))


def test_gate_of_the_ik_follows_the_plain_argmax():
    visits = segments(0, 2, 0, 3)
    rest = np.tile(CHAIN.rest, (4, 1))
    result = run((visits, rest, np.full((4, 3), np.nan)), ControlSettings(contact_states=CONTACT))
    np.testing.assert_array_equal(result.contact, [False, True, False, True])


def test_unknown_contact_states_are_refused(interaction):
    with pytest.raises(UserError, match="contact state 6 is unknown; valid: 0 to 5"):
        run(interaction, ControlSettings(contact_states=frozenset({2, 6})))
    with pytest.raises(UserError, match="contact state -1"):
        state_mask(frozenset({-1}), 6)
    with pytest.raises(UserError, match="takes up to 62"):
        state_mask(frozenset({1}), 63)
    assert state_mask(frozenset({0, 61}), 62) == 1 + 2**61


def test_control_of_a_trial_takes_milliseconds(interaction):
    """430 frames with IK in every frame, and link poses of command and ghost; 1.5 ms on an idle core."""
    used = own(ControlSettings(contact_states=frozenset(range(STATES))))
    best = np.inf
    for _ in range(20):
        begin = time.perf_counter()
        result = used.run(frames(*interaction), used.start())
        ROBOT.link_poses(result.joints)
        ROBOT.link_poses(interaction[1])
        best = min(best, time.perf_counter() - begin)
    assert best < 0.025, "with shape checks on, and on a busy machine"
