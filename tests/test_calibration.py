"""Calibration: exact Gaussian predictions, and the closed form of the energy score in one dimension."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from mild_viz.evaluation.calibration import (
    LEVELS,
    calibration,
    ellipsoid_coverage,
    energy_score,
    gaussian_samples,
    interval_coverage,
    mahalanobis_squared,
)
from tests.passes import make_pass


def predictions(n: int, size: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, covariances, and truths that are drawn from just these Gaussians."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(n, size, size))
    covariance = roots @ roots.swapaxes(1, 2) + 0.1 * np.eye(size)
    mean = 3.0 * rng.normal(size=(n, size))
    truth = mean + (np.linalg.cholesky(covariance) @ rng.normal(size=(n, size, 1)))[..., 0]
    return mean, covariance, truth


def test_distance_is_that_of_the_closed_form() -> None:
    mean, covariance = np.zeros((1, 2)), np.array([[[4.0, 0.0], [0.0, 0.25]]])
    np.testing.assert_allclose(mahalanobis_squared(mean, covariance, np.array([[2.0, 1.0]])), [5.0])


@pytest.mark.parametrize("size", [1, 2, 5])
def test_ellipsoids_of_the_truth_cover_what_they_say(size: int) -> None:
    n = 20_000
    for level, share in zip(LEVELS, ellipsoid_coverage(*predictions(n, size)), strict=True):
        assert share == pytest.approx(level, abs=4 * np.sqrt(level * (1 - level) / n))


def test_coverage_shows_a_wrong_covariance() -> None:
    mean, covariance, truth = predictions(5_000, 3)
    small, large = ellipsoid_coverage(mean, covariance / 9, truth), ellipsoid_coverage(mean, covariance * 9, truth)
    assert small[1] < 0.35 and large[0] > 0.85


def test_intervals_of_the_truths_samples_cover_what_they_say() -> None:
    mean, covariance, truth = predictions(4_000, 2)
    samples = gaussian_samples(mean, covariance, 400, np.random.default_rng(1))
    assert interval_coverage(samples, truth) == pytest.approx(LEVELS, abs=0.02)


def test_samples_have_the_given_moments() -> None:
    mean, covariance, _ = predictions(1, 3)
    samples = gaussian_samples(mean, covariance, 200_000, np.random.default_rng(0))[0]
    np.testing.assert_allclose(samples.mean(0), mean[0], atol=0.03)
    np.testing.assert_allclose(np.cov(samples.T), covariance[0], atol=0.1)


def test_energy_score_in_one_dimension_is_the_ranked_probability_score() -> None:
    """Closed form for N(m, s^2): s (z (2 F(z) - 1) + 2 f(z) - 1 / sqrt(pi)), z = (y - m) / s."""
    mean, std = np.array([0.0, 1.0, -2.0]), np.array([1.0, 0.5, 2.0])
    truth = np.array([0.3, 2.5, -2.0])
    z = (truth - mean) / std
    expected = std * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / np.sqrt(np.pi))
    samples = gaussian_samples(mean[:, None], std[:, None, None] ** 2, 400_000, np.random.default_rng(0))
    np.testing.assert_allclose(energy_score(samples, truth[:, None]), expected, rtol=0.01)


def test_energy_score_of_a_certain_prediction_is_its_distance() -> None:
    samples = np.tile([3.0, 4.0], (1, 7, 1))
    np.testing.assert_allclose(energy_score(samples, np.zeros((1, 2))), [5.0])


def test_the_true_covariance_has_the_best_energy_score() -> None:
    mean, covariance, truth = predictions(3_000, 2)
    scores = [
        energy_score(gaussian_samples(mean, factor * covariance, 100, np.random.default_rng(0)), truth).mean()
        for factor in (0.05, 1.0, 8.0)
    ]
    assert scores[1] < min(scores[0], scores[2])


def test_incomplete_windows_are_left_out() -> None:
    one = make_pass([0] * 6)
    mean, covariance, truth = predictions(6, 2)
    one = replace(one, partner_mean=mean, partner_covariance=covariance, partner_truth=truth)
    errors = np.zeros(6)
    errors[4:] = np.nan
    lost = truth.copy()
    lost[4:] = np.nan
    measured = calibration([replace(one, errors=errors, partner_truth=lost)], np.random.default_rng(0))
    assert measured is not None and measured.n_windows == 4
    assert measured.coverage == ellipsoid_coverage(mean[:4], covariance[:4], truth[:4])
    assert measured.energy_point == pytest.approx(np.linalg.norm(mean - truth, axis=1)[:4].mean())
    assert np.isfinite([measured.energy, measured.decoded_energy, *measured.decoded_coverage]).all()
    assert calibration([replace(one, errors=np.full(6, np.nan))], np.random.default_rng(0)) is None


def test_the_same_generator_gives_the_same_scores() -> None:
    one = make_pass([0] * 6)
    first, second = (calibration([one], np.random.default_rng(3)) for _ in range(2))
    assert first == second != calibration([one], np.random.default_rng(4))
