"""Gaussian mixture regression: closed forms, and the paper's own sums."""

from __future__ import annotations

import numpy as np
import pytest

from mild_viz.latent.gmr import condition
from mild_viz.latent.hmm import HMM
from tests.models import random_hmm


@pytest.fixture
def hmm() -> HMM:
    return random_hmm(np.random.default_rng(0), 3, 4)


def test_one_gaussian_has_the_textbook_conditional() -> None:
    joint = random_hmm(np.random.default_rng(1), 1, 5)
    z = np.random.default_rng(2).normal(size=(7, 2))
    mean, covariance = condition(joint, z, np.zeros((7, 1)))
    mu, sigma = joint.emission_means[0], joint.emission_covariances[0]
    gain = sigma[2:, :2] @ np.linalg.inv(sigma[:2, :2])
    np.testing.assert_allclose(mean, mu[2:] + (z - mu[:2]) @ gain.T, atol=1e-12)
    np.testing.assert_allclose(covariance[0], sigma[2:, 2:] - gain @ sigma[:2, 2:], atol=1e-12)


def paper(hmm: HMM, z: np.ndarray, alpha: np.ndarray, std: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Eqs. conditioning-withcov-K-i to -sigma-t for one step, term by term as the paper prints them."""
    size = len(z)
    means, second = [], []
    for mu, sigma in zip(hmm.emission_means, hmm.emission_covariances, strict=True):
        posterior = np.zeros((size, size)) if std is None else np.diag(std**2)
        gain = sigma[size:, :size] @ np.linalg.inv(sigma[:size, :size] + posterior)
        means.append(mu[size:] + gain @ (z - mu[:size]))
        second.append(sigma[size:, size:] - gain @ sigma[:size, size:] + np.outer(means[-1], means[-1]))
    mean = np.sum([a * m for a, m in zip(alpha, means, strict=True)], axis=0)
    return mean, np.sum([a * s for a, s in zip(alpha, second, strict=True)], axis=0) - np.outer(mean, mean)


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("with_covariance", [False, True])
def test_equals_the_papers_equations(hmm: HMM, with_covariance: bool, size: int) -> None:
    rng = np.random.default_rng(3)
    z, std, alpha = rng.normal(size=(9, size)), rng.uniform(0.05, 2.0, (9, size)), rng.dirichlet(np.ones(3), 9)
    mean, covariance = condition(hmm, z, np.log(alpha), std if with_covariance else None)
    for n in range(9):
        expected = paper(hmm, z[n], alpha[n], std[n] if with_covariance else None)
        np.testing.assert_allclose(mean[n], expected[0], atol=1e-12)
        np.testing.assert_allclose(covariance[n], expected[1], atol=1e-11)


def test_covariances_are_symmetric_and_positive_definite(hmm: HMM) -> None:
    rng = np.random.default_rng(4)
    alpha = rng.dirichlet(0.1 * np.ones(3), 50)
    for std in (None, rng.uniform(0, 3, (50, 2))):
        _, covariance = condition(hmm, 100 * rng.normal(size=(50, 2)), np.log(alpha), std)
        np.testing.assert_array_equal(covariance, covariance.transpose(0, 2, 1))
        assert np.linalg.eigvalsh(covariance).min() > 0


def test_a_vague_posterior_leaves_the_states_own_means(hmm: HMM) -> None:
    alpha = np.array([[0.2, 0.5, 0.3]])
    mean, _ = condition(hmm, np.array([[3.0, -3.0]]), np.log(alpha), np.full((1, 2), 1e6))
    np.testing.assert_allclose(mean, alpha @ hmm.emission_means[:, 2:], atol=1e-9)


@pytest.mark.parametrize("with_covariance", [False, True])
def test_a_lost_observation_leaves_the_mixture_of_the_states(hmm: HMM, with_covariance: bool) -> None:
    alpha = np.array([[0.2, 0.5, 0.3], [0.1, 0.1, 0.8]])
    z = np.array([[np.nan, np.nan], [0.1, 0.2]])
    std = np.where(np.isnan(z), np.nan, 0.1) if with_covariance else None
    mean, covariance = condition(hmm, z, np.log(alpha), std)
    means = hmm.emission_means[:, 2:]
    expected = alpha[0] @ means
    np.testing.assert_allclose(mean[0], expected, atol=1e-12)
    spread = means - expected
    within = np.einsum("s,sab->ab", alpha[0], hmm.emission_covariances[:, 2:, 2:])
    np.testing.assert_allclose(covariance[0], within + np.einsum("s,sa,sb->ab", alpha[0], spread, spread), atol=1e-12)
    assert np.isfinite(mean).all() and np.isfinite(covariance).all()
