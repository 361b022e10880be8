"""EM with durations: its guarantees, recovery of what made the data, and what little data does to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mild_viz.latent.em import TRANSITION_FLOOR, Observations, fit
from mild_viz.latent.hmm import log_emission
from mild_viz.latent.hsmm import HSMM, check_hsmm
from mild_viz.latent.hsmm.em import em_step, equal_segments
from mild_viz.latent.state_models import STATE_MODELS, fit_from_equal_segments

DURATIONS, SPREADS = np.array([20.0, 45.0, 30.0]), np.array([3.0, 8.0, 4.0])
PLACES = np.array([[0.0, 0.0], [1.5, 0.0], [1.5, 1.5], [0.0, 1.5]])


def sample(rng: np.random.Generator, n_sequences: int = 12, last: int = 25) -> list[np.ndarray]:
    """Trajectories through four places; the stay in the last is cut off."""
    result = []
    for _ in range(n_sequences):
        lengths = [*np.maximum(rng.normal(DURATIONS, SPREADS).round().astype(int), 1), last]
        result.append(np.repeat(PLACES, lengths, axis=0) + 0.5 * rng.normal(size=(sum(lengths), 2)))
    return result


@pytest.fixture(scope="module")
def data() -> list[np.ndarray]:
    return sample(np.random.default_rng(0))


def test_the_start_is_the_equal_split(data: list[np.ndarray]) -> None:
    start = check_hsmm(equal_segments(data, 4, 1e-2), "start")
    np.testing.assert_allclose(start.duration_means, np.mean([len(sequence) for sequence in data]) / 4)
    np.testing.assert_allclose(np.diagonal(start.transition_matrix, 1), 1.0, atol=1e-4)
    np.testing.assert_allclose(np.diagonal(start.transition_matrix), [0, 0, 0, 1], atol=1e-5)
    first = np.concatenate([sequence[: -(-len(sequence) // 4)] for sequence in data])
    np.testing.assert_allclose(start.emission_means[0], first.mean(0), atol=0.05)


def test_log_likelihood_never_falls(data: list[np.ndarray]) -> None:
    model, history = equal_segments(data, 4, 0.1), []
    for _ in range(15):
        model, total = em_step(model, data, floor=0.0, transition_floor=0.0, prior_segments=0.0)
        history.append(total)
    # The moments of the counts are the maximum but for the Gaussian's discretisation and its lost tails.
    assert (np.diff(history) > -1e-2).all(), np.diff(history)
    assert history[-1] > history[0] + 50


def test_durations_and_places_are_recovered() -> None:
    sequences = sample(np.random.default_rng(1), n_sequences=60)
    model, _ = fit(equal_segments(sequences, 4, 1e-3), sequences, 1e-3, 30, step=em_step)
    assert isinstance(model, HSMM)
    np.testing.assert_allclose(model.duration_means[:3], DURATIONS, atol=1.5)
    np.testing.assert_allclose(model.duration_stds[:3], SPREADS, rtol=0.3)
    np.testing.assert_allclose(model.emission_means, PLACES, atol=0.05)
    assert model.transition_matrix[3, 3] > 0.999 and model.initial_probs[0] > 0.999
    whole = np.concatenate([np.repeat(range(4), [20, 45, 30, 25])])
    made = PLACES[whole] + 0.5 * np.random.default_rng(2).normal(size=(len(whole), 2))
    path, _ = model.viterbi(log_emission(model, made))
    assert (path == whole).mean() > 0.95


def test_known_durations_explain_more_than_an_hmms(data: list[np.ndarray]) -> None:
    """The same steps of EM from the same split: durations that are far from geometric are worth likelihood."""
    fresh = sample(np.random.default_rng(3))
    totals = {}
    for name, entry in STATE_MODELS.items():
        model = fit_from_equal_segments(name, data, 4, 1e-3, 30)
        totals[name] = entry.em_step(model, Observations.of(fresh), 1e-3, TRANSITION_FLOOR)[1]
    assert totals["hsmm"] > totals["hmm"] + 2 * len(fresh)


def test_a_few_trials_do_not_make_a_duration_certain(data: list[np.ndarray]) -> None:
    alike = [data[0] + 0.1 * shift for shift in (0, 1, 2)]
    model, _ = fit(equal_segments(alike, 4, 1e-2), alike, 1e-2, 20, step=em_step)
    assert isinstance(model, HSMM)
    assert (model.duration_stds >= model.duration_means / 3 / np.sqrt(4) - 0.3).all()
    bold, _ = em_step(model, alike, 1e-2, prior_segments=0.0)
    assert bold.duration_stds[:3].max() < model.duration_stds[:3].min()
    assert bold.duration_stds.min() >= 1.0


def test_a_state_that_does_not_occur_gets_the_equal_splits_duration(data: list[np.ndarray]) -> None:
    start = equal_segments(data, 4, 1e-2)
    means = start.emission_means.copy()
    means[2] = 1e3  # explains nothing
    durations = np.array([30.0, 30.0, 1.0, 30.0])
    revived, _ = em_step(replace(start, emission_means=means, duration_means=durations), data, 1e-2)
    assert np.abs(revived.emission_means[2] - start.emission_means[2]).max() < 1e-9
    assert revived.duration_means[2] == pytest.approx(start.duration_means[2], rel=0.05)


def test_a_state_whose_end_is_never_seen_lasts_no_longer_than_a_sequence(data: list[np.ndarray]) -> None:
    model, _ = fit(
        equal_segments([s[:40] for s in data], 2, 1e-2), [s[:15] for s in data], 1e-2, 60, -1.0, step=em_step
    )
    assert isinstance(model, HSMM)
    assert (model.duration_means <= 15.0).all() and (model.duration_stds <= 15.0).all()


def test_lost_observations_carry_no_weight(data: list[np.ndarray]) -> None:
    gappy = [sequence.copy() for sequence in data]
    for sequence in gappy:
        sequence[10:14] = np.nan
    holed, _ = fit(equal_segments(gappy, 4, 1e-2), gappy, 1e-2, 15, step=em_step)
    whole, _ = fit(equal_segments(data, 4, 1e-2), data, 1e-2, 15, step=em_step)
    assert isinstance(holed, HSMM) and isinstance(whole, HSMM)
    np.testing.assert_allclose(holed.emission_means, whole.emission_means, atol=0.05)
    np.testing.assert_allclose(holed.duration_means[:3], whole.duration_means[:3], rtol=0.05)


def test_only_the_last_state_may_follow_itself(data: list[np.ndarray]) -> None:
    for floor in (0.0, 1e-6):
        model = equal_segments(data, 4, 1e-2)
        for _ in range(5):
            model, _ = em_step(model, data, 1e-2, transition_floor=floor)
        check_hsmm(model, "model")
        assert (model.transition_matrix[0, 2:] >= floor / 2).all()


def test_one_state_and_flat_data_work() -> None:
    flat = [np.zeros((9, 3)), np.zeros((12, 3))]
    for n_states in (1, 2):
        model = fit_from_equal_segments("hsmm", flat, n_states, 1e-3, 5)
        assert isinstance(model, HSMM)
        check_hsmm(model, "flat")
