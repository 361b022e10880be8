"""Both halves of an iteration of EM: against the sum over every state path, logarithms, moments in two passes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mild_viz.latent import kernels
from mild_viz.latent.em import expectation, maximise_emissions, maximise_transitions
from mild_viz.latent.hmm import HMM, forward_filter, log_emission, safe_log
from tests.models import random_hmm

FAR = 1e3
"""So far from every state that probabilities underflow."""


def by_enumeration(hmm: HMM, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Posterior of the states (N, S), expected transitions (S, S) and log p(z), straight from the definition."""
    log_density, steps = log_emission(hmm, z), np.arange(len(z))
    log_initial, log_transition = safe_log(hmm.initial_probs), safe_log(hmm.transition_matrix)
    paths = np.array(list(itertools.product(range(hmm.n_states), repeat=len(z))))
    log_joint = log_initial[paths[:, 0]] + log_density[steps, paths].sum(1)
    log_joint += log_transition[paths[:, :-1], paths[:, 1:]].sum(1)
    total = np.logaddexp.reduce(log_joint)
    gamma, counts = np.zeros((len(z), hmm.n_states)), np.zeros((hmm.n_states, hmm.n_states))
    for path, weight in zip(paths, np.exp(log_joint - total), strict=True):
        gamma[steps, path] += weight
        np.add.at(counts, (path[:-1], path[1:]), weight)
    return gamma, counts, float(total)


def left_to_right(rng: np.random.Generator) -> HMM:
    """A model that can neither go back nor skip a state."""
    hmm = random_hmm(rng, 3, 2)
    transition = np.array([[0.7, 0.3, 0.0], [0.0, 0.6, 0.4], [0.0, 0.0, 1.0]])
    return HMM(np.array([1.0, 0.0, 0.0]), transition, hmm.emission_means, hmm.emission_covariances)


def recordings(rng: np.random.Generator, spread: float) -> list[np.ndarray]:
    """Three sequences of unlike lengths; one has a lost observation."""
    sequences = [spread * rng.normal(size=(n, 2)) for n in (7, 1, 5)]
    sequences[2][3] = np.nan
    return sequences


@pytest.mark.parametrize("spread", [1.0, FAR])
@pytest.mark.parametrize("impossible", [False, True])
def test_expectation_sums_over_all_paths(impossible: bool, spread: float) -> None:
    rng = np.random.default_rng(5)
    hmm = left_to_right(rng) if impossible else random_hmm(rng, 3, 2)
    sequences = recordings(rng, spread)
    found = expectation(hmm, sequences)
    gammas, counts, totals = zip(*(by_enumeration(hmm, sequence) for sequence in sequences), strict=True)
    np.testing.assert_allclose(found.gamma, np.concatenate(gammas), atol=1e-9)
    np.testing.assert_allclose(found.transitions, sum(counts), atol=1e-9)
    np.testing.assert_allclose(found.initial, sum(gamma[0] for gamma in gammas), atol=1e-9)
    assert found.log_likelihood == pytest.approx(sum(totals), rel=1e-12)


def scaled(hmm: HMM, z: np.ndarray) -> tuple[float, np.ndarray]:
    """log p(z) and the posterior by `smooth_scaled`; NaN where it must not answer."""
    likelihood = log_emission(hmm, z)
    alpha, flow, gamma = (np.empty(likelihood.shape) for _ in range(3))
    return kernels.smooth_scaled(hmm.initial_probs, hmm.transition_matrix, likelihood, alpha, flow, gamma), gamma


def test_scaled_probabilities_give_up_where_no_path_leads() -> None:
    hmm = left_to_right(np.random.default_rng(5))
    near, at_last = np.repeat(hmm.emission_means, 2, axis=0), np.repeat(hmm.emission_means[-1:], 4, axis=0)
    assert scaled(hmm, near)[0] == pytest.approx(forward_filter(hmm, log_emission(hmm, near))[1], abs=1e-12)
    # The last state cannot be reached at once, and from anywhere else the observations are all but impossible.
    sharp = HMM(hmm.initial_probs, hmm.transition_matrix, hmm.emission_means, 1e-4 * hmm.emission_covariances)
    assert np.isnan(scaled(sharp, at_last)[0])
    gamma, counts, total = by_enumeration(sharp, at_last)
    found = expectation(sharp, [at_last])
    np.testing.assert_allclose(found.gamma, gamma, atol=1e-12)
    np.testing.assert_allclose(found.transitions, counts, atol=1e-12)
    assert found.log_likelihood == pytest.approx(total, rel=1e-12)


def test_scaled_probabilities_give_up_where_the_ruled_out_state_turns_out_true() -> None:
    # Two states that are never left. The first step rules one out, by 800 nats; each of the others is likely enough
    # given those before it, but together they speak for that state, by 1000 nats.
    hmm = HMM(np.array([0.5, 0.5]), np.eye(2), np.array([[0.0], [10.0]]), np.ones((2, 1, 1)))
    z = np.array([-75.0] + 100 * [6.0])[:, None]
    assert np.isnan(scaled(hmm, z)[0])
    found = expectation(hmm, [z])
    np.testing.assert_allclose(found.gamma, np.tile([0.0, 1.0], (101, 1)), atol=1e-12)
    np.testing.assert_allclose(found.transitions, np.diag([0.0, 100.0]), atol=1e-10)
    assert found.log_likelihood == pytest.approx(np.log(0.5) + log_emission(hmm, z)[:, 1].sum(), rel=1e-12)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), spread=st.floats(0.1, 1e4), impossible=st.booleans())
def test_expectation_follows_the_smoother_in_logarithms(seed: int, spread: float, impossible: bool) -> None:
    rng = np.random.default_rng(seed)
    hmm = left_to_right(rng) if impossible else random_hmm(rng, 5, 2)
    z = spread * rng.normal(size=(30, 2))
    likelihood = log_emission(hmm, z)
    found = expectation(hmm, [z])
    np.testing.assert_allclose(found.gamma, np.exp(hmm.smooth(likelihood)), atol=1e-8)
    np.testing.assert_allclose(found.transitions.sum(), len(z) - 1, rtol=1e-8)
    assert found.log_likelihood == pytest.approx(forward_filter(hmm, likelihood)[1], rel=1e-12)


@pytest.mark.parametrize("distance", [0.0, 10.0, 1e4, 1e7])
def test_moments_keep_their_digits_far_from_the_centre(distance: float) -> None:
    rng = np.random.default_rng(7)
    away = distance * np.array([1.0, -1.0, 1.0])
    sequences = [
        np.concatenate([0.01 * rng.normal(size=(40, 3)) + away, 0.01 * rng.normal(size=(30, 3)) - away])
        for _ in range(3)
    ]
    sequences[1][5] = np.nan
    first = np.tile(np.arange(70) < 40, 3)  # one state to a place
    gamma = np.stack([first, ~first], axis=1).astype(float)
    means, covariances = maximise_emissions(sequences, gamma, 0.25)
    rows = np.concatenate(sequences)
    seen = ~np.isnan(rows).any(1)
    for state in range(2):
        mean = np.average(rows[seen], axis=0, weights=gamma[seen, state])
        np.testing.assert_allclose(means[state], mean, rtol=1e-12, atol=1e-12)
        expected = np.cov(rows[seen].T, aweights=gamma[seen, state], bias=True)
        np.testing.assert_allclose(covariances[state] - 0.25 * np.eye(3), expected, rtol=1e-6, atol=1e-9)


def test_transitions_without_a_count_stay_as_they_were() -> None:
    previous = np.array([[0.9, 0.1], [0.2, 0.8]])
    counts = np.array([[3.0, 1.0], [0.0, 0.0]])
    np.testing.assert_allclose(maximise_transitions(counts, previous, 0.0), [[0.75, 0.25], [0.2, 0.8]])
    floored = maximise_transitions(np.array([[4.0, 0.0], [0.0, 2.0]]), previous, 1e-3)
    np.testing.assert_allclose(floored, np.array([[1.0, 1e-3], [1e-3, 1.0]]) / 1.001)
