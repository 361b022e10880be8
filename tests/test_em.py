"""EM: against hmmlearn from the same start, and its own guarantees."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hmmlearn.hmm import GaussianHMM

from mild_viz.latent.em import em_step, equal_segments, fit
from mild_viz.latent.hmm import HMM


def sequences(rng: np.random.Generator, size: int = 4) -> list[np.ndarray]:
    """Trajectories that pass through three places, with their own timing."""
    places = 3.0 * rng.normal(size=(3, size))
    result = []
    for _ in range(6):
        lengths = rng.integers(20, 40, size=3)
        result.append(
            np.concatenate([p + 0.4 * rng.normal(size=(n, size)) for p, n in zip(places, lengths, strict=True)])
        )
    return result


@pytest.fixture
def data() -> list[np.ndarray]:
    return sequences(np.random.default_rng(0))


def test_log_likelihood_follows_hmmlearn(data: list[np.ndarray]) -> None:
    start = equal_segments(data, 4, 1e-2)
    hmm, ours = start, []
    for _ in range(8):
        hmm, total = em_step(hmm, data, floor=0.0, transition_floor=0.0)
        ours.append(total)

    theirs = GaussianHMM(
        4, covariance_type="full", init_params="", n_iter=8, tol=-np.inf, min_covar=0.0, covars_prior=0.0,
        covars_weight=0, implementation="log",
    )  # fmt: skip
    theirs.startprob_, theirs.transmat_ = start.initial_probs.copy(), start.transition_matrix.copy()
    theirs.means_, theirs.covars_ = start.emission_means.copy(), start.emission_covariances.copy()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs.fit(np.concatenate(data), [len(sequence) for sequence in data])
    np.testing.assert_allclose(ours, list(theirs.monitor_.history), atol=1e-3)
    np.testing.assert_allclose(hmm.emission_means, theirs.means_, atol=1e-4)


def test_log_likelihood_never_falls_without_a_floor(data: list[np.ndarray]) -> None:
    _, history = fit(equal_segments(data, 3, 0.5), data, 0.0, 15, tolerance=0.0)
    assert (np.diff(history) > -1e-6).all()
    assert history[-1] > history[0] + 10


def test_lost_observations_carry_no_weight(data: list[np.ndarray]) -> None:
    start = equal_segments(data, 3, 1e-2)
    gappy = [sequence.copy() for sequence in data]
    for sequence in gappy:
        sequence[10:14] = np.nan
    hmm, _ = fit(equal_segments(gappy, 3, 1e-2), gappy, 1e-2, 10)
    whole, _ = fit(start, data, 1e-2, 10)
    assert np.isfinite(hmm.emission_means).all()
    np.testing.assert_allclose(hmm.emission_means, whole.emission_means, atol=0.3)


def test_a_dead_state_is_placed_anew(data: list[np.ndarray]) -> None:
    start = equal_segments(data, 3, 1e-2)
    means = start.emission_means.copy()
    means[1] = 1e3  # explains nothing
    dead = HMM(start.initial_probs, start.transition_matrix, means, start.emission_covariances)
    revived, _ = em_step(dead, data, 1e-2)
    assert np.abs(revived.emission_means[1] - start.emission_means[1]).max() < 1e-9


def test_the_floor_keeps_covariances_positive_definite() -> None:
    flat = [np.zeros((30, 3)), np.zeros((30, 3))]
    hmm, _ = fit(equal_segments(flat, 2, 1e-3), flat, 1e-3, 5)
    assert np.linalg.eigvalsh(hmm.emission_covariances).min() >= 1e-3 - 1e-12
    np.testing.assert_allclose(hmm.transition_matrix.sum(1), 1.0)


def test_a_transition_that_was_never_seen_stays_possible(data: list[np.ndarray]) -> None:
    start = equal_segments(data, 3, 1e-2)
    impossible = HMM(
        np.array([1.0, 0.0, 0.0]), np.triu(start.transition_matrix) / np.triu(start.transition_matrix).sum(1)[:, None],
        start.emission_means, start.emission_covariances,
    )  # fmt: skip
    for before in (start, impossible):
        after, _ = em_step(before, data, 1e-2)
        np.testing.assert_allclose(after.transition_matrix.sum(1), 1.0, atol=1e-12)
        np.testing.assert_allclose(after.initial_probs.sum(), 1.0, atol=1e-12)
        backwards = after.transition_matrix[np.tril_indices(3, -1)]
        np.testing.assert_allclose(backwards, 1e-6, rtol=0.01)
        np.testing.assert_allclose(after.initial_probs[1:], 1e-6, rtol=0.01)
    none, _ = em_step(impossible, data, 1e-2, transition_floor=0.0)
    assert (none.transition_matrix[np.tril_indices(3, -1)] == 0.0).all()
