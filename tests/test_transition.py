"""The transition state: what it is fitted to, its probability against brute force, and what it changes in control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from mild_viz.latent.hmm import HMM, forward_filter, log_emission
from mild_viz.latent.transition import TransitionState, fit_transition_state
from mild_viz.robot.model import load_robot
from mild_viz.settings import ControlSettings
from tests.controllers import LOW, cut, frames, unhindered
from tests.models import random_hmm, random_hsmm

REACH, CONTACT, RETURN = 0, 1, 2
TOUCH = frozenset({CONTACT})


def active(*runs: tuple[int, int]) -> np.ndarray:
    """A forward variable in which `state` is the most likely for `steps`, run after run of (state, steps)."""
    states = np.concatenate([np.full(steps, state) for state, steps in runs])
    log_alpha = np.full((len(states), 3), np.log(0.05))
    log_alpha[np.arange(len(states)), states] = np.log(0.9)
    return log_alpha


def marginal() -> HMM:
    """Three states in two dimensions, with covariances that can be told apart."""
    covariances = np.stack([np.diag([1.0, 2.0]), np.diag([3.0, 4.0]), np.diag([50.0, 60.0])])
    return HMM(np.array([1.0, 0, 0]), np.full((3, 3), 1 / 3), np.zeros((3, 2)), covariances)


def test_fit_recovers_a_planted_distribution() -> None:
    rng = np.random.default_rng(0)
    mean, covariance = np.array([1.0, -2.0]), np.array([[0.5, 0.3], [0.3, 0.4]])
    latents, human, joint = [], [], []
    for trial in range(600):
        lag = trial % 6  # one trial of six has none
        z = 1e3 + rng.normal(size=(40, 2))  # what is elsewhere must not leak in
        z[10 : 10 + lag] = rng.multivariate_normal(mean, covariance, lag)
        latents.append(z)
        joint.append(active((REACH, 10), (CONTACT, 20), (RETURN, 10)))
        human.append(active((REACH, 10 + lag), (CONTACT, 20 - lag), (RETURN, 10)))
    state = fit_transition_state(marginal(), TOUCH, latents, human, joint)
    assert state is not None and state.contact_states == TOUCH
    np.testing.assert_allclose(state.mean, mean, atol=0.05)
    np.testing.assert_allclose(state.covariance, covariance, atol=0.05)
    # ten steps of reaching and the boundary itself, or the human's own contact instead of it
    assert state.hazard == pytest.approx(500 / (500 * 11 + 100 * 10 + 1))


def test_few_steps_lean_on_the_states_around_the_boundary() -> None:
    rng = np.random.default_rng(1)
    z = rng.normal(size=(9, 2))
    joint, human = active((REACH, 3), (CONTACT, 6)), active((REACH, 5), (CONTACT, 4))
    state = fit_transition_state(marginal(), TOUCH, [z], [human], [joint])
    assert state is not None and state.hazard == pytest.approx(1 / 5)
    late, around = z[3:5], np.diag([2.0, 3.0])  # the mean of reaching and contact; return has no part
    np.testing.assert_allclose(state.mean, late.mean(0))
    np.testing.assert_allclose(state.covariance, (2 * np.cov(late.T, bias=True) + 4 * around) / (2 + 4))


@pytest.mark.parametrize(
    ("human", "joint", "rows"),
    [
        ([(REACH, 8), (CONTACT, 12)], [(REACH, 5), (CONTACT, 15)], slice(5, 8)),
        ([(REACH, 20)], [(REACH, 5), (CONTACT, 10), (RETURN, 5)], slice(5, 15)),  # it never sees the contact
        ([(REACH, 5), (RETURN, 3), (CONTACT, 12)], [(REACH, 5), (CONTACT, 15)], slice(5, 8)),  # lost elsewhere
        ([(REACH, 10), (CONTACT, 10)], [(REACH, 5), (CONTACT, 2), (REACH, 5), (CONTACT, 8)], slice(5, 7)),
        ([(REACH, 5), (CONTACT, 15)], [(REACH, 5), (CONTACT, 15)], None),  # no lag
        ([(REACH, 3), (CONTACT, 17)], [(REACH, 5), (CONTACT, 15)], None),  # the human alone is early
        ([(CONTACT, 3), (REACH, 5), (CONTACT, 12)], [(REACH, 5), (CONTACT, 15)], None),  # was in contact before
        ([(REACH, 20)], [(REACH, 15), (RETURN, 5)], None),  # no contact
        ([(REACH, 5), (CONTACT, 15)], [(CONTACT, 20)], None),  # no reaching
    ],
)
def test_which_steps_count(human: list, joint: list, rows: slice | None) -> None:
    z = np.random.default_rng(2).normal(size=(20, 2))
    state = fit_transition_state(marginal(), TOUCH, [z], [active(*human)], [active(*joint)])
    assert (state is None) == (rows is None)
    if state is not None:
        np.testing.assert_allclose(state.mean, z[rows].mean(0))


def test_steps_without_an_observation_do_not_count() -> None:
    z = np.random.default_rng(3).normal(size=(20, 2))
    z[6] = np.nan
    human, joint = active((REACH, 8), (CONTACT, 12)), active((REACH, 5), (CONTACT, 15))
    state = fit_transition_state(marginal(), TOUCH, [z], [human], [joint])
    assert state is not None
    np.testing.assert_allclose(state.mean, z[[5, 7]].mean(0))
    z[5:8] = np.nan
    assert fit_transition_state(marginal(), TOUCH, [z], [human], [joint]) is None


@pytest.mark.parametrize("make", [random_hmm, random_hsmm])
def test_probability_is_that_of_bayes_rule(make: Callable[[np.random.Generator, int, int], HMM]) -> None:
    """Against the density of the newest observation as a ratio of brute-force likelihoods, and SciPy's Gaussian."""
    rng = np.random.default_rng(4)
    hmm = make(rng, 4, 3)
    state = TransitionState(rng.normal(size=3), np.diag([0.5, 1.0, 2.0]) + 0.2, 0.07, frozenset({1}))
    z = rng.normal(size=(30, 3))
    z[12:15] = np.nan
    likelihood = log_emission(hmm, z)
    result = state.log_probability(z, likelihood, forward_filter(hmm, likelihood)[0])
    total = 0.0
    for n in range(len(z)):
        before, total = total, forward_filter(hmm, likelihood[: n + 1])[1]
        if np.isnan(z[n]).any():
            assert result[n] == -np.inf
            continue
        gaussian = multivariate_normal(state.mean, state.covariance)  # pyright: ignore[reportArgumentType]
        entered = 0.07 * gaussian.pdf(z[n])
        assert np.exp(result[n]) == pytest.approx(entered / (entered + 0.93 * np.exp(total - before)), rel=1e-9)


# a model in which the human alone lags: he stops before he is there, and only the partner shows the contact

LAG, BEGIN, PAUSE = 6, 20, 1.65


def lagging_model() -> HMM:
    """One dimension each: where contact begins, the human pauses where reaching explains him better than contact."""
    means = np.array([[0.5, 0.0], [3.0, 3.0], [-4.0, 0.0]])
    covariances = np.stack([np.diag([0.3, 0.2]), np.diag([0.4, 0.2]), np.diag([0.3, 0.2])])
    transition = np.array([[0.9, 0.1, 1e-6], [1e-6, 0.9, 0.1], [1e-6, 1e-6, 1.0]])
    return HMM(np.array([1.0, 0, 0]), transition / transition.sum(1, keepdims=True), means, covariances)


def lagging_trial(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    human = np.concatenate([np.linspace(-0.3, 0.6, BEGIN), np.full(LAG, PAUSE), np.full(20, 3.0), np.full(14, -4.0)])
    partner = np.concatenate([np.zeros(BEGIN), np.full(LAG + 20, 3.0), np.zeros(14)])
    return tuple((track + 0.03 * rng.normal(size=len(track)))[:, None] for track in (human, partner))  # pyright: ignore[reportReturnType]


@pytest.fixture(scope="module")
def lagging() -> tuple[np.ndarray, np.ndarray, TransitionState]:
    """Forward variable of the human alone and log P(tau) of a new trial, and the state fitted to ten others."""
    rng, hmm = np.random.default_rng(5), lagging_model()
    human_hmm = hmm.marginal(slice(0, 1))

    def alphas(human: np.ndarray, partner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        both = np.concatenate([human, partner], axis=1)
        alone = forward_filter(human_hmm, log_emission(human_hmm, human))[0]
        return alone, forward_filter(hmm, log_emission(hmm, both))[0]

    trials = [lagging_trial(rng) for _ in range(10)]
    human_only, joint = zip(*(alphas(*trial) for trial in trials), strict=True)
    state = fit_transition_state(human_hmm, TOUCH, [human for human, _ in trials], human_only, joint)
    assert state is not None and state.hazard == pytest.approx(10 / (10 * (BEGIN + 1) + 1))
    human, partner = lagging_trial(rng)
    log_alpha, log_alpha_joint = alphas(human, partner)
    assert np.flatnonzero(log_alpha.argmax(1) == CONTACT)[0] == BEGIN + LAG
    assert np.flatnonzero(log_alpha_joint.argmax(1) == CONTACT)[0] == BEGIN
    return log_alpha, state.log_probability(human, log_emission(human_hmm, human), log_alpha), state


ROBOT = load_robot("pepper")


def stiffness(log_alpha: np.ndarray, log_transition: np.ndarray | None, **settings: Any) -> np.ndarray:
    n = len(log_alpha)
    chosen = replace(ControlSettings(contact_states=TOUCH), **settings)
    rest, unseen = np.tile(ROBOT.chain.rest, (n, 1)), np.full((n, 3), np.nan)
    controller = unhindered(ROBOT.chain, chosen, "handshake", log_alpha.shape[1])
    result = controller.run(frames(log_alpha, rest, unseen, log_transition), controller.start())
    np.testing.assert_array_equal(result.contact, np.isin(log_alpha.argmax(1), sorted(chosen.contact_states or ())))
    return result.stiffness[:, 0]


def test_the_arm_softens_earlier_by_the_lag(lagging: tuple[np.ndarray, np.ndarray, TransitionState]) -> None:
    log_alpha, log_transition, state = lagging
    assert abs(state.mean[0] - PAUSE) < 0.05
    without, with_state = stiffness(log_alpha, None), stiffness(log_alpha, log_transition)
    low = without == LOW
    np.testing.assert_array_equal(np.flatnonzero(low), np.arange(BEGIN + LAG, BEGIN + LAG + 20))
    np.testing.assert_array_equal(np.flatnonzero(with_state == LOW), np.arange(BEGIN, BEGIN + LAG + 20))


def log(*values: float) -> np.ndarray:
    return np.log(np.array(values))


def test_no_back_transition_after_the_transition_state() -> None:
    """It fires in one step only; reaching, which then is the most likely state again, is out of the question."""
    log_alpha = active((REACH, 10), (CONTACT, 3), (RETURN, 5))
    log_alpha[:10] = log(0.9, 0.08, 0.02)
    log_transition = np.full(18, -np.inf)
    log_transition[4] = np.log(0.6)
    low = np.flatnonzero(stiffness(log_alpha, log_transition) == LOW)
    np.testing.assert_array_equal(low, np.arange(4, 13))
    # where the rest points to the way back rather than to contact, it was a false alarm
    log_alpha[6:10] = log(0.9, 0.02, 0.08)
    low = np.flatnonzero(stiffness(log_alpha, log_transition) == LOW)
    np.testing.assert_array_equal(low, [4, 5, 10, 11, 12])


def test_the_transition_state_speaks_only_before_contact() -> None:
    log_alpha = active((REACH, 5), (CONTACT, 5), (RETURN, 5))
    late = np.full(15, -np.inf)
    late[10:] = np.log(0.99)  # the way back passes by the same place
    np.testing.assert_array_equal(stiffness(log_alpha, late), stiffness(log_alpha, None))


def test_it_must_exceed_what_is_left_for_reaching() -> None:
    log_alpha = np.tile(log(0.5, 0.3, 0.2), (1, 1))
    for share, expected in ((0.33, 1.0), (0.34, LOW)):  # p > (1 - p) / 2 from 1/3 on
        assert stiffness(log_alpha, log(share)) == expected
    assert stiffness(log_alpha, log(0.9), contact_states=frozenset()) == 1.0
    assert stiffness(log_alpha, log(0.9), stiffness=False) == 1.0


def plain_stiffness(log_alpha: np.ndarray, log_transition: np.ndarray, contact_states: frozenset[int]) -> np.ndarray:
    """The rule, written for reading: tau is one more candidate, an index after the last state."""
    tau = log_alpha.shape[1]
    reached = touched = False
    visited: set[int] = set()
    result = []
    for row, log_p in zip(np.exp(log_alpha), log_transition, strict=True):
        shares = {state: (1 - np.exp(log_p)) * share for state, share in enumerate(row)}
        touched = touched or max(shares, key=shares.__getitem__) in contact_states
        if not touched:
            shares[tau] = np.exp(log_p)
            if not reached:
                visited.add(int(row.argmax()))
        reached = reached or touched or max(shares, key=shares.__getitem__) == tau
        left = {state: share for state, share in shares.items() if state not in visited}
        result.append(reached and max(left, key=left.__getitem__) in contact_states | {tau})
    return np.where(result, LOW, 1.0)


def test_stiffness_equals_a_plain_loop_and_a_stream() -> None:
    rng = np.random.default_rng(6)
    seen = set()
    for _ in range(60):
        states = frozenset(rng.choice(5, size=2, replace=False).tolist())
        shares = rng.dirichlet([0.3] * 5, size=40)
        shares[:15, sorted(states)] *= 0.01  # contact comes later, as a rule
        log_alpha, log_transition = np.log(shares / shares.sum(1, keepdims=True)), np.log(rng.beta(0.2, 2.0, size=40))
        expected = plain_stiffness(log_alpha, log_transition, states)
        np.testing.assert_array_equal(stiffness(log_alpha, log_transition, contact_states=states), expected)
        controller = unhindered(ROBOT.chain, ControlSettings(contact_states=states), "handshake", 5)
        whole = frames(log_alpha, np.tile(ROBOT.chain.rest, (40, 1)), np.full((40, 3), np.nan), log_transition)
        carry, parts = controller.start(), []
        for n in range(40):
            part = controller.run(cut(whole, slice(n, n + 1)), carry)
            carry = part.carry
            parts.append(part.stiffness[0, 0])
        np.testing.assert_array_equal(parts, expected)
        seen.add(tuple(expected != stiffness(log_alpha, None, contact_states=states)))
    assert len(seen) > 20  # the transition state did change something
