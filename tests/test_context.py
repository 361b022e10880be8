"""Conditioning on a history: contexts, the regression of every state, and whole trials against single windows."""

from __future__ import annotations

import numpy as np
import pytest

from mild_viz.errors import UserError
from mild_viz.latent.context import CLOCK_SPAN, ContextLayout, condition_on_context, fit_regression
from mild_viz.latent.gmr import condition
from mild_viz.prediction import advance, predict
from tests.models import LAYOUT, random_checkpoint, random_hmm


def test_a_context_holds_the_past_latents_and_the_clock() -> None:
    z = np.arange(12.0).reshape(6, 2)
    layout = ContextLayout(lags=(2,), clock=3.0)
    contexts = layout.contexts(z, np.empty((0, 2)), 0, rate=2.0)
    assert contexts.shape == (6, layout.size(2)) == (6, 4 + 16)
    np.testing.assert_array_equal(contexts[:, :2], z)
    np.testing.assert_array_equal(contexts[:, 2:4], z[[0, 0, 0, 1, 2, 3]])  # the first one stands in at the beginning
    for bump in range(16):  # one a second
        expected = 3.0 * np.exp(-0.5 * (np.arange(6) / 2.0 - bump) ** 2)
        np.testing.assert_allclose(contexts[:, 4 + bump], expected)
    late = layout.times(np.array([2 * CLOCK_SPAN, 1000.0]), rate=2.0)
    np.testing.assert_array_equal(late[0], late[1])  # it stands still
    continued = layout.contexts(z[4:], z[2:4], 4, rate=2.0)
    np.testing.assert_array_equal(continued, contexts[4:])


def test_an_impossible_clock_is_refused() -> None:
    with pytest.raises(UserError, match="clock is -1.0; valid: a number from 0 to 100"):
        ContextLayout(clock=-1.0)


@pytest.mark.parametrize("lags", [(0,), (-3,), (2000,)])
def test_an_impossible_lag_is_refused(lags: tuple[int, ...]) -> None:
    with pytest.raises(UserError, match="lags are .*; valid: whole numbers of frames from 1 to 1000"):
        ContextLayout(lags)


def test_without_noise_one_state_is_least_squares() -> None:
    rng = np.random.default_rng(0)
    contexts = rng.normal(size=(500, 4))
    slope, level = rng.normal(size=(3, 4)), rng.normal(size=3)
    robot = contexts @ slope.T + level + 0.1 * rng.normal(size=(500, 3))
    # mass 501: the pseudo step at the overall means changes no mean and scales both moments alike
    fitted = fit_regression(contexts, robot, np.ones((500, 1)), 0.0)
    design = np.c_[contexts, np.ones(500)]
    expected = np.linalg.lstsq(design, robot, rcond=None)[0]
    np.testing.assert_allclose(fitted.gain[0], expected[:4].T, atol=1e-9)
    np.testing.assert_allclose(fitted.offset[0], expected[4], atol=1e-9)
    residual = robot - design @ expected
    np.testing.assert_allclose(fitted.covariance[0], residual.T @ residual / 501 + 1e-4 * np.eye(3), atol=1e-9)


def test_noise_is_the_posterior_covariance_of_the_paper() -> None:
    """With the newest latent alone as context, K_i is that of Eq. conditioning-withcov-K-i."""
    rng = np.random.default_rng(1)
    hmm = random_hmm(rng, 1, 6)
    z = rng.multivariate_normal(hmm.emission_means[0], hmm.emission_covariances[0], size=200_000)
    std = 0.7
    fitted = fit_regression(z[:, :3], z[:, 3:], np.ones((len(z), 1)), std**2)
    log_alpha = np.zeros((4, 1))
    mean, _ = condition(hmm, z[:4, :3], log_alpha, np.full((4, 3), std))
    ours, _ = condition_on_context(
        fitted, z[:4, :3], log_alpha, hmm.emission_means[:, 3:], hmm.emission_covariances[:, 3:, 3:]
    )
    np.testing.assert_allclose(ours, mean, atol=0.03)


def test_an_unseen_step_gives_the_states_own_gaussians() -> None:
    rng = np.random.default_rng(2)
    hmm = random_hmm(rng, 3, 6)
    weights = rng.dirichlet(np.ones(3), size=50)
    fitted = fit_regression(rng.normal(size=(50, 4)), rng.normal(size=(50, 3)), weights, 0.1)
    mean, covariance = condition_on_context(
        fitted,
        np.full((2, 4), np.nan),
        np.log(weights[:2]),
        hmm.emission_means[:, 3:],
        hmm.emission_covariances[:, 3:, 3:],
    )
    expected_mean, expected_covariance = condition(hmm, np.full((2, 3), np.nan), np.log(weights[:2]))
    np.testing.assert_allclose(mean, expected_mean, atol=1e-12)
    np.testing.assert_allclose(covariance, expected_covariance, atol=1e-12)


def test_a_state_that_is_never_visited_predicts_the_overall_mean() -> None:
    rng = np.random.default_rng(3)
    robot = rng.normal(size=(40, 2))
    weights = np.c_[np.ones(40), np.zeros(40)]
    fitted = fit_regression(rng.normal(size=(40, 3)), robot, weights, 0.1)
    assert np.isfinite(fitted.gain).all() and np.linalg.eigvalsh(fitted.covariance).min() > 0
    np.testing.assert_allclose(fitted.offset[1], robot.mean(0), atol=1e-9)


@pytest.mark.parametrize("gap", [None, (0, 4), (9, 25)])
def test_window_by_window_gives_the_numbers_of_the_whole_trial(gap: tuple[int, int] | None) -> None:
    checkpoint = random_checkpoint(n_own=3)
    human = np.random.default_rng(4).normal(size=(40, 90))
    if gap is not None:
        human[slice(*gap)] = np.nan
    whole = predict(checkpoint, "v4", "wave", human)
    models = checkpoint.members("v4")
    carries = tuple(model.start() for model in models)
    for n in range(len(human)):
        said, carries = advance(models, "v4", "wave", human[n : n + 1], carries, checkpoint.rate)
        for field in ("log_alpha", "robot_mean", "robot_covariance", "decoded"):
            np.testing.assert_allclose(getattr(said, field)[0], getattr(whole, field)[n], atol=1e-9)
        assert all(len(carry.history) <= LAYOUT.n_history for carry in carries)
    assert np.isfinite(whole.decoded).all()


def test_the_decoded_windows_are_the_average_of_the_models() -> None:
    checkpoint = random_checkpoint(n_own=3)
    human = np.random.default_rng(5).normal(size=(12, 90))
    single = [
        advance((model,), "v4", "wave", human, (model.start(),), 30.0)[0].decoded for model in checkpoint.members("v4")
    ]
    np.testing.assert_allclose(predict(checkpoint, "v4", "wave", human).decoded, np.mean(single, axis=0), atol=1e-12)
    assert np.abs(single[0] - single[1]).max() > 1e-3
