"""Segmentation: sequences written by hand, whose answers can be counted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mild_viz.checkpoint import load_checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.errors import UserError
from mild_viz.evaluation.passes import run_passes
from mild_viz.evaluation.segmentation import (
    back_transitions,
    boundary_times,
    change_delays,
    normalised_mutual_information,
    phase_fit,
    phase_of_states,
    segmentation,
)
from mild_viz.paths import default_checkpoint
from mild_viz.pipeline import infer, state_visits
from tests.passes import make_pass


def test_mutual_information_of_known_partitions() -> None:
    a = np.array([0, 0, 1, 1])
    assert normalised_mutual_information(a, np.array([5, 5, 2, 2])) == pytest.approx(1.0)  # names do not matter
    assert normalised_mutual_information(a, np.array([0, 1, 0, 1])) == 0.0  # independent
    assert normalised_mutual_information(a, np.zeros(4, int)) == 0.0
    assert normalised_mutual_information(np.zeros(4, int), np.ones(4, int)) == 1.0
    # Halving one part: I = log 2, H = log 2 and 1.5 log 2
    assert normalised_mutual_information(a, np.array([0, 1, 2, 2])) == pytest.approx(2 / 2.5)


@settings(deadline=None)  # the first example pays for an import
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 4)), min_size=2, max_size=40))
def test_mutual_information_is_that_of_scikit_learn(pairs: list[tuple[int, int]]) -> None:
    from sklearn.metrics import normalized_mutual_info_score

    first, second = np.array(pairs).T
    expected = normalized_mutual_info_score(first, second)
    assert normalised_mutual_information(first, second) == pytest.approx(expected, abs=1e-9)


def test_back_transitions_are_counted() -> None:
    assert back_transitions(np.array([0, 0, 1, 1, 2])) == 0
    assert back_transitions(np.array([0, 1, 2, 0])) == 1  # ends as it begins
    assert back_transitions(np.array([0, 1, 2, 1, 2, 2, 3])) == 2


def test_a_change_is_compared_with_the_nearest_entry_into_the_same_state() -> None:
    reference = np.array([0] * 10 + [1] * 10 + [2] * 10)
    other = np.array([0] * 13 + [1] * 5 + [2] * 12)
    np.testing.assert_array_equal(change_delays(reference, other, 10.0), [3, -2])
    np.testing.assert_array_equal(change_delays(reference, other, 2.0), [np.nan, -2])
    flickering = np.array([0] * 4 + [1] * 2 + [0] * 5 + [1] * 9 + [0] * 10)
    np.testing.assert_array_equal(change_delays(reference, flickering, 10.0), [1, np.nan])
    assert len(change_delays(np.zeros(30, int), reference, 10.0)) == 0


def test_states_stand_for_the_phase_they_are_mostly_in() -> None:
    active, phase = np.array([0, 0, 0, 1, 1, 3]), np.array([1, 1, 2, 2, 2, 3])
    np.testing.assert_array_equal(phase_of_states(active, phase, 4), [1, 2, 0, 3])


def test_boundaries_are_the_first_and_last_moments() -> None:
    phase = np.array([0, 0, 1, 1, 2, 2, 2, 3, 3, 0])
    np.testing.assert_array_equal(boundary_times(phase), [2, 4, 7, 9])
    flicker = np.array([0, 2, 1, 1, 2, 2, 2, 3, 2, 0])
    np.testing.assert_array_equal(boundary_times(flicker), [1, 1, 9, 9])
    np.testing.assert_array_equal(boundary_times(np.array([1, 2, 2, 2])), [np.nan, 1, np.nan, np.nan])
    assert np.isnan(boundary_times(np.zeros(5, int))).all()


def test_summary_of_one_trial() -> None:
    joint = [0] * 4 + [1] * 6 + [2] * 10
    used = segmentation([make_pass([0] * 5 + [1] * 5 + [2] * 8 + [1] * 2, joint)])
    assert used.occupancy == pytest.approx((0.25, 0.35, 0.4, 0.0))
    assert used.duration == pytest.approx((0.5, 0.35, 0.8, 0.0))
    assert (used.changes, used.back_transitions) == (3.0, 1.0)
    assert used.agreement == pytest.approx(17 / 20)
    assert used.delay_frames == 0.5 and used.delay == pytest.approx(0.05)  # one frame late, and in time
    assert used.matched == 1.0
    assert used.entropy < 1e-6


def test_trials_are_pooled_by_time() -> None:
    used = segmentation([make_pass([0] * 10), make_pass([1] * 30)])
    assert used.occupancy == pytest.approx((0.25, 0.75, 0.0, 0.0))
    assert used.delay is None and used.matched == 1.0


def test_trials_of_several_actions_are_refused() -> None:
    with pytest.raises(UserError, match="handshake, wave"):
        segmentation([make_pass([0, 1]), make_pass([0, 1], action="wave")])
    with pytest.raises(UserError, match="none"):
        segmentation([])


def test_phases_are_learnt_on_training_and_measured_on_test_trials() -> None:
    phase = [0] * 5 + [1] * 5 + [2] * 10 + [3] * 5 + [0] * 5
    train = make_pass([0] * 5 + [1] * 5 + [2] * 10 + [3] * 5 + [0] * 5, phase=phase)
    late = make_pass([0] * 5 + [1] * 8 + [2] * 5 + [3] * 7 + [0] * 5, phase=phase)
    fit = phase_fit([train], [late])
    assert fit is not None
    assert fit.phase_of_state == (0, 1, 2, 3)
    assert [one.delay for one in fit.boundaries] == pytest.approx([0.0, 0.3, -0.2, 0.0])
    assert [one.absolute for one in fit.boundaries] == pytest.approx([0.0, 0.3, 0.2, 0.0])
    assert {(one.n_found, one.n_true) for one in fit.boundaries} == {(1, 1)}
    perfect = phase_fit([train], [train])
    assert perfect is not None and perfect.nmi == pytest.approx(1.0) and fit.nmi < 0.9
    idle = phase_fit([train], [make_pass([0] * 30, phase=phase)])
    assert idle is not None and idle.nmi == 0.0
    assert [(one.delay, one.n_found, one.n_true) for one in idle.boundaries] == [(None, 0, 1)] * 4
    assert phase_fit([train], [make_pass([0, 1])]) is None


def test_passes_are_the_pipelines_inference() -> None:
    """The demo model on demo trials: alphas, phases, errors and visits equal those of `pipeline.infer`."""
    model, source = load_checkpoint(default_checkpoint("demo")), load_dataset("demo")
    trials = [trial for trial in source.test if trial.action == "rocket"]
    for trial, one in zip(trials, run_passes(model, model.variants[-1], trials), strict=True):
        said = infer(model, trial, model.variants[-1])
        np.testing.assert_allclose(one.log_alpha, said.log_alpha_human, atol=1e-9)
        np.testing.assert_allclose(one.log_alpha_joint, said.log_alpha_joint, atol=1e-9)
        np.testing.assert_allclose(one.partner_covariance, said.robot_latent_covariance, atol=1e-12)
        np.testing.assert_allclose(one.errors, said.window_error, atol=1e-12)
        np.testing.assert_allclose(one.first_frame(one.predicted), said.joints_decoded, atol=1e-12)
        np.testing.assert_array_equal(one.phase, said.phase)
        durations, occupancy = state_visits(said.active_state, said.n_states, said.rate)
        used = segmentation([one])
        np.testing.assert_allclose(used.duration, durations)
        np.testing.assert_allclose(used.occupancy, occupancy)


def test_the_demo_models_states_follow_the_true_phases() -> None:
    model, source = load_checkpoint(default_checkpoint("demo")), load_dataset("demo")
    train, test = (
        run_passes(model, model.variants[0], [trial for trial in trials if trial.action == "rocket"])
        for trials in (source.train, source.test)
    )
    fit = phase_fit(train, test)
    assert fit is not None and fit.nmi > 0.5
    contact = fit.boundaries[1]
    assert contact.n_found == contact.n_true == 4
    assert contact.absolute is not None and contact.absolute < 0.3
