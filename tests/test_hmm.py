"""Filter, smoother, Viterbi: against the sum over every state path of small models."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from mild_viz.errors import UserError
from mild_viz.latent.hmm import (
    HMM,
    check_hmm,
    forward_filter,
    log_emission,
    unobserved_forward,
)
from tests.models import random_hmm


def path_log_probabilities(hmm: HMM, z: np.ndarray) -> dict[tuple[int, ...], float]:
    """log p(path, z) of every path, straight from the definition."""
    densities = [multivariate_normal(m, c) for m, c in zip(hmm.emission_means, hmm.emission_covariances, strict=True)]
    result = {}
    for path in itertools.product(range(hmm.n_states), repeat=len(z)):
        value = np.log(hmm.initial_probs[path[0]]) + sum(
            np.log(hmm.transition_matrix[a, b]) for a, b in itertools.pairwise(path)
        )
        for state, row in zip(path, z, strict=True):
            value += 0.0 if np.isnan(row).any() else densities[state].logpdf(row)
        result[path] = float(value)
    return result


@pytest.fixture(params=[0, 1, 2])
def example(request: pytest.FixtureRequest) -> tuple[HMM, np.ndarray]:
    rng = np.random.default_rng(request.param)
    z = rng.normal(size=(6, 2))
    if request.param == 2:
        z[3] = np.nan  # a lost observation
    return random_hmm(rng, 3, 2), z


def test_log_emission_is_the_normal_density(example: tuple[HMM, np.ndarray]) -> None:
    hmm, z = example
    got = log_emission(hmm, z)
    for state in range(hmm.n_states):
        expected = multivariate_normal(hmm.emission_means[state], hmm.emission_covariances[state]).logpdf(z)
        seen = ~np.isnan(z).any(1)
        np.testing.assert_allclose(got[seen, state], expected[seen], rtol=1e-12)
        assert (got[~seen] == 0).all()


def test_forward_filter_sums_over_all_paths(example: tuple[HMM, np.ndarray]) -> None:
    hmm, z = example
    log_alpha, total = forward_filter(hmm, log_emission(hmm, z))
    for n in range(len(z)):
        paths = path_log_probabilities(hmm, z[: n + 1])
        joint = [np.logaddexp.reduce([v for p, v in paths.items() if p[-1] == i]) for i in range(hmm.n_states)]
        np.testing.assert_allclose(log_alpha[n], joint - np.logaddexp.reduce(joint), atol=1e-12)
    assert total == pytest.approx(np.logaddexp.reduce(list(path_log_probabilities(hmm, z).values())), abs=1e-11)


def test_smoother_sums_over_all_paths(example: tuple[HMM, np.ndarray]) -> None:
    hmm, z = example
    log_gamma = hmm.smooth(log_emission(hmm, z))
    paths = path_log_probabilities(hmm, z)
    total = np.logaddexp.reduce(list(paths.values()))
    for n in range(len(z)):
        for i in range(hmm.n_states):
            expected = np.logaddexp.reduce([v for p, v in paths.items() if p[n] == i]) - total
            assert log_gamma[n, i] == pytest.approx(expected, abs=1e-12)


def test_viterbi_finds_the_best_of_all_paths(example: tuple[HMM, np.ndarray]) -> None:
    hmm, z = example
    path, score = hmm.viterbi(log_emission(hmm, z))
    paths = path_log_probabilities(hmm, z)
    best = max(paths, key=lambda p: paths[p])
    assert tuple(path) == best
    assert score == pytest.approx(paths[best], abs=1e-11)


def test_filter_continues_from_the_previous_step(example: tuple[HMM, np.ndarray]) -> None:
    hmm, z = example
    likelihood = log_emission(hmm, z)
    whole, _ = forward_filter(hmm, likelihood)
    head, _, carry = hmm.filter(likelihood[:3])
    tail, _, _ = hmm.filter(likelihood[3:], carry)
    np.testing.assert_allclose(np.concatenate([head, tail]), whole, atol=1e-12)


def test_unobserved_forward_is_the_chain_alone() -> None:
    hmm = random_hmm(np.random.default_rng(3), 4, 2)
    expected = [hmm.initial_probs @ np.linalg.matrix_power(hmm.transition_matrix, n) for n in range(5)]
    np.testing.assert_allclose(np.exp(unobserved_forward(hmm, 5)), expected, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), spread=st.floats(0.1, 1e4))
def test_alpha_sums_to_one_even_far_from_every_state(seed: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    hmm = random_hmm(rng, 5, 3)
    z = spread * rng.normal(size=(30, 3))
    log_alpha, total = forward_filter(hmm, log_emission(hmm, z))
    np.testing.assert_allclose(np.exp(log_alpha).sum(1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.exp(hmm.smooth(log_emission(hmm, z))).sum(1), 1.0, atol=1e-12)
    assert np.isfinite(total)


def test_invalid_models_are_named() -> None:
    hmm = random_hmm(np.random.default_rng(4), 3, 2)
    crooked = HMM(hmm.initial_probs, 0.9 * hmm.transition_matrix, hmm.emission_means, hmm.emission_covariances)
    with pytest.raises(UserError, match="file: rows of transition_matrix"):
        check_hmm(crooked, "file")
    flat = HMM(hmm.initial_probs, hmm.transition_matrix, hmm.emission_means, 0 * hmm.emission_covariances)
    with pytest.raises(UserError, match="not positive definite"):
        check_hmm(flat, "file")


@pytest.mark.parametrize("name", HMM.__dataclass_fields__)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_named(name: str, value: float) -> None:
    hmm = random_hmm(np.random.default_rng(4), 3, 2)
    tensor = getattr(hmm, name).copy()
    tensor.flat[0] = value
    with pytest.raises(UserError, match=f"file: {name} has values that are not finite"):
        check_hmm(replace(hmm, **{name: tensor}), "file")


def test_an_asymmetric_covariance_is_named() -> None:
    hmm = random_hmm(np.random.default_rng(4), 3, 2)
    skew = hmm.emission_covariances.copy()
    assert check_hmm(hmm, "file") is hmm
    skew[1, 0, 1] += 1e-3
    with pytest.raises(UserError, match="file: emission_covariances are not symmetric"):
        check_hmm(replace(hmm, emission_covariances=skew), "file")
