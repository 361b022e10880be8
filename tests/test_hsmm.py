"""The semi-Markov model: against the sum over every segmentation, the HMM of geometric durations, and streams."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from mild_viz.errors import UserError
from mild_viz.latent.hmm import HMM, forward_filter, log_emission, unobserved_forward
from mild_viz.latent.hsmm import HSMM, check_hsmm, kernels
from tests.models import TableHSMM, random_hmm, random_hsmm, without_returns

Segments = tuple[tuple[int, int], ...]
"""State and length of every segment."""


def segmentations(n_steps: int, n_states: int, longest: int) -> Iterator[Segments]:
    if n_steps == 0:
        yield ()
    for steps in range(1, min(n_steps, longest) + 1):
        for state in range(n_states):
            for rest in segmentations(n_steps - steps, n_states, longest):
                yield ((state, steps), *rest)


def states_of(segments: Segments) -> list[int]:
    return [state for state, steps in segments for _ in range(steps)]


def segment_log_probabilities(hsmm: HSMM, z: np.ndarray) -> dict[Segments, float]:
    """log p(segments, z) of every segmentation, straight from the definition; the last segment goes on unseen."""
    densities = [multivariate_normal(m, c) for m, c in zip(hsmm.emission_means, hsmm.emission_covariances, strict=True)]
    durations = np.exp(hsmm.log_durations)
    result = {}
    for segments in segmentations(len(z), hsmm.n_states, durations.shape[1]):
        probability = hsmm.initial_probs[segments[0][0]]
        for (state, steps), (following, _) in zip(segments[:-1], segments[1:], strict=True):
            probability *= durations[state, steps - 1] * hsmm.transition_matrix[state, following]
        state, steps = segments[-1]
        probability *= durations[state, steps - 1 :].sum()
        if probability > 0:
            seen = [(s, row) for s, row in zip(states_of(segments), z, strict=True) if not np.isnan(row).any()]
            result[segments] = float(np.log(probability)) + sum(float(densities[s].logpdf(row)) for s, row in seen)
    return result


def log_shares(values: dict[Segments, float], n_states: int, step: int) -> np.ndarray:
    """log p(state at a step) from the log probabilities of all segmentations."""
    joint = np.full(n_states, -np.inf)
    for segments, value in values.items():
        state = states_of(segments)[step]
        joint[state] = np.logaddexp(joint[state], value)
    return joint - np.logaddexp.reduce(joint)


def table_example(rng: np.random.Generator, longest: int = 3) -> TableHSMM:
    base = random_hsmm(rng, 3, 2, staying=0.4)
    return TableHSMM(
        base.initial_probs, base.transition_matrix, base.emission_means, base.emission_covariances,
        base.duration_means, base.duration_stds, rng.dirichlet(np.ones(longest), size=3),
    )  # fmt: skip


@pytest.fixture(params=range(4), ids=["gaussian", "lost observation", "table", "staying"])
def example(request: pytest.FixtureRequest) -> tuple[HSMM, np.ndarray]:
    rng = np.random.default_rng(request.param)
    z = 1.5 * rng.normal(size=(6, 2))
    if request.param == 2:
        return table_example(rng), z
    hsmm = replace(
        random_hsmm(rng, 3, 2, staying=0.3 if request.param == 3 else 0.0),
        duration_means=np.array([1.2, 2.0, 0.7]), duration_stds=np.array([0.7, 0.5, 0.4]),
    )  # fmt: skip
    assert hsmm.log_durations.shape[1] == 4
    if request.param == 1:
        z[2:4] = np.nan
    return hsmm, z


def test_durations_are_a_gaussian_on_whole_steps() -> None:
    hsmm = replace(
        random_hsmm(np.random.default_rng(0), 2, 2),
        duration_means=np.array([20.0, 4.0]), duration_stds=np.array([5.0, 1.0]),
    )  # fmt: skip
    durations, steps = np.exp(hsmm.log_durations), np.arange(1, 41)
    assert durations.shape == (2, 40)
    np.testing.assert_allclose(durations.sum(1), 1.0, atol=1e-12)
    np.testing.assert_allclose(durations @ steps, [20.0, 4.0], atol=1e-2)
    np.testing.assert_allclose(durations @ steps**2 - (durations @ steps) ** 2, [25.0, 1.0], rtol=1e-2)
    np.testing.assert_allclose(durations[0, 24] / durations[0, 19], np.exp(-0.5), rtol=1e-12)


def test_forward_filter_sums_over_all_segmentations(example: tuple[HSMM, np.ndarray]) -> None:
    hsmm, z = example
    log_alpha, total = forward_filter(hsmm, log_emission(hsmm, z))
    for n in range(len(z)):
        values = segment_log_probabilities(hsmm, z[: n + 1])
        np.testing.assert_allclose(log_alpha[n], log_shares(values, 3, n), atol=1e-11)
    values = segment_log_probabilities(hsmm, z)
    assert total == pytest.approx(np.logaddexp.reduce(list(values.values())), abs=1e-11)


@pytest.mark.parametrize("way", ["scaled", "logarithms"])
def test_smoother_and_counts_sum_over_all_segmentations(
    example: tuple[HSMM, np.ndarray], way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    hsmm, z = example
    if way == "logarithms":
        monkeypatch.setattr(kernels, "count_scaled", lambda *_: np.nan)
    likelihood, values = log_emission(hsmm, z), segment_log_probabilities(hsmm, z)
    log_gamma = hsmm.smooth(likelihood)
    for n in range(len(z)):
        np.testing.assert_allclose(log_gamma[n], log_shares(values, 3, n), atol=1e-11)

    transitions, counted = np.zeros((3, 3)), np.zeros(hsmm.log_durations.shape)
    hsmm.count(likelihood, transitions, counted)
    expected_transitions, expected = np.zeros((3, 3)), np.zeros(counted.shape)
    total, durations = np.logaddexp.reduce(list(values.values())), np.exp(hsmm.log_durations)
    for segments, value in values.items():
        share = np.exp(value - total)
        for (state, steps), (following, _) in zip(segments[:-1], segments[1:], strict=True):
            expected_transitions[state, following] += share
            expected[state, steps - 1] += share
        state, steps = segments[-1]
        ahead = durations[state, steps - 1 :]
        expected[state, steps - 1 :] += share * ahead / ahead.sum()
    np.testing.assert_allclose(transitions, expected_transitions, atol=1e-11)
    np.testing.assert_allclose(counted, expected, atol=1e-11)


def test_viterbi_finds_the_best_of_all_segmentations(example: tuple[HSMM, np.ndarray]) -> None:
    hsmm, z = example
    path, score = hsmm.viterbi(log_emission(hsmm, z))
    values = segment_log_probabilities(hsmm, z)
    best = max(values, key=lambda segments: values[segments])
    assert path.tolist() == states_of(best)
    assert score == pytest.approx(values[best], abs=1e-11)


def geometric(hmm: HMM, longest: int) -> TableHSMM:
    """The semi-Markov model that an HMM is: its durations are geometric."""
    stay = np.diagonal(hmm.transition_matrix)
    durations = (1 - stay)[:, None] * stay[:, None] ** np.arange(longest)
    off = hmm.transition_matrix * ~np.eye(hmm.n_states, dtype=bool) / (1 - stay)[:, None]
    return TableHSMM(
        hmm.initial_probs, off, hmm.emission_means, hmm.emission_covariances,
        np.ones(hmm.n_states), np.ones(hmm.n_states), durations / durations.sum(1, keepdims=True),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_geometric_durations_are_the_hmm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    transition = 0.7 * np.eye(4) + 0.3 * rng.dirichlet(np.ones(4), size=4)
    hmm = replace(random_hmm(rng, 4, 3), transition_matrix=transition)
    stay = np.diagonal(transition).max()
    hsmm = geometric(hmm, int(np.log(1e-15) / np.log(stay)))
    z = 2.0 * rng.normal(size=(150, 3))
    z[40:60] = np.nan
    likelihood = log_emission(hmm, z)
    ours, total = forward_filter(hsmm, likelihood)
    expected, expected_total = forward_filter(hmm, likelihood)
    np.testing.assert_allclose(ours, expected, atol=1e-9)
    assert total == pytest.approx(expected_total, abs=1e-9)
    np.testing.assert_allclose(hsmm.smooth(likelihood), hmm.smooth(likelihood), atol=1e-9)
    np.testing.assert_allclose(unobserved_forward(hsmm, 150), unobserved_forward(hmm, 150), atol=1e-9)
    path, score = hsmm.viterbi(likelihood)
    expected_path, expected_score = hmm.viterbi(likelihood)
    np.testing.assert_array_equal(path, expected_path)
    assert score == pytest.approx(expected_score, abs=1e-9)


@pytest.mark.parametrize("spread", [1.0, 5.0, 300.0])
def test_probabilities_and_logarithms_count_alike(spread: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where probabilities leave the range of numbers, which only logarithms bear."""
    rng = np.random.default_rng(9)
    hsmm = replace(random_hsmm(rng, 4, 2, 20.0, 0.5), duration_stds=np.array([1.0, 4.0, 0.5, 2.0]))
    likelihood = log_emission(hsmm, spread * np.repeat(rng.normal(size=(8, 2)), 15, axis=0))
    scaled, totals, found = kernels.count_scaled, [], []

    def watched(*args: np.ndarray) -> float:
        totals.append(scaled(*args))
        return totals[-1]

    for way in (watched, lambda *_: np.nan):
        monkeypatch.setattr(kernels, "count_scaled", way)
        transitions, durations = np.zeros((4, 4)), np.zeros(hsmm.log_durations.shape)
        log_gamma, total = hsmm.count(likelihood, transitions, durations)
        found.append((np.exp(log_gamma), transitions, durations, total))
    for ours, expected in zip(*found, strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-9, atol=1e-9)
    assert np.isnan(totals) == [spread == 300.0]


def test_a_last_state_that_follows_itself_is_never_left() -> None:
    rng = np.random.default_rng(5)
    hsmm = random_hsmm(rng, 3, 2, staying=1.0)
    alpha = np.exp(unobserved_forward(hsmm, 2000))
    assert alpha[-1, 2] == pytest.approx(1.0, abs=1e-9)
    assert (np.diff(alpha[:, 2]) > -1e-12).all()


def test_without_observations_a_state_lasts_its_duration() -> None:
    hsmm = HSMM(
        np.array([1.0, 0, 0]), np.array([[0.0, 1, 0], [0, 0, 1], [0, 0, 1]]), np.zeros((3, 2)),
        np.tile(np.eye(2), (3, 1, 1)), np.array([20.0, 30.0, 10.0]), np.array([2.0, 2.0, 2.0]),
    )  # fmt: skip
    active = unobserved_forward(hsmm, 70).argmax(1)
    np.testing.assert_array_equal(active, np.repeat([0, 1, 2], [20, 30, 20]))


@pytest.mark.parametrize("chunk", [1, 2, 7])
def test_a_stream_gives_what_the_whole_sequence_gives(chunk: int) -> None:
    rng = np.random.default_rng(6)
    hsmm = random_hsmm(rng, 4, 3).marginal(slice(0, 2))
    z = 2.0 * rng.normal(size=(100, 2))
    z[30:50] = np.nan
    likelihood = log_emission(hsmm, z)
    whole, _ = forward_filter(hsmm, likelihood)
    carry, parts = None, []
    for start in range(0, len(z), chunk):
        part, _, carry = hsmm.filter(likelihood[start : start + chunk], carry)
        parts.append(part)
    np.testing.assert_allclose(np.concatenate(parts), whole, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), spread=st.floats(0.1, 1e4), longest=st.floats(1.0, 80.0))
def test_alpha_sums_to_one_even_far_from_every_state(seed: int, spread: float, longest: float) -> None:
    rng = np.random.default_rng(seed)
    hsmm = random_hsmm(rng, 5, 3, longest)
    z = spread * rng.normal(size=(30, 3))
    z[10:12] = np.nan
    log_alpha, total = forward_filter(hsmm, log_emission(hsmm, z))
    np.testing.assert_allclose(np.exp(log_alpha).sum(1), 1.0, atol=1e-12)
    np.testing.assert_allclose(np.exp(hsmm.smooth(log_emission(hsmm, z))).sum(1), 1.0, atol=1e-12)
    assert np.isfinite(total)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("duration_means", np.nan, "duration_means has values that are not finite"),
        ("duration_stds", np.inf, "duration_stds has values that are not finite"),
        ("duration_stds", 0.0, r"duration_stds are \[.* steps; valid: 0.001 to 10000"),
        ("duration_means", -3.0, r"duration_means are \[.* steps; valid"),
        ("duration_means", 1e6, r"duration_means are \[.* steps; valid"),
        ("emission_means", np.nan, "emission_means has values that are not finite"),
    ],
)
def test_invalid_models_are_named(name: str, value: float, message: str) -> None:
    hsmm = random_hsmm(np.random.default_rng(7), 3, 2, staying=0.5)
    assert check_hsmm(hsmm, "file") is hsmm
    tensor = getattr(hsmm, name).copy()
    tensor.flat[0] = value
    with pytest.raises(UserError, match=f"file: {message}"):
        check_hsmm(replace(hsmm, **{name: tensor}), "file")


def test_a_state_that_follows_itself_is_named() -> None:
    hsmm = random_hsmm(np.random.default_rng(8), 3, 2)
    wrong = np.roll(without_returns(hsmm.transition_matrix, 0.5), 1, axis=(0, 1))
    with pytest.raises(UserError, match=r"file: transition_matrix lets states \[0\] follow themselves; .* last"):
        check_hsmm(replace(hsmm, transition_matrix=wrong), "file")
