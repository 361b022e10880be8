"""Expectation-maximisation for the hidden semi-Markov model: durations besides what the HMM learns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from mild_viz.latent import em
from mild_viz.latent.em import (
    TRANSITION_FLOOR,
    Observations,
    Sequences,
    maximise_emissions,
    maximise_transitions,
)
from mild_viz.latent.hmm import log_emission
from mild_viz.latent.hsmm.model import HSMM

STD_FLOOR = 1.0
"""Smallest standard deviation of a duration [steps]."""

RELATIVE_STD = 1.0 / 3.0
"""Standard deviation of a duration over its mean, where nothing is known."""

FEWEST_SEGMENTS = 1.0
"""A state that occurs less often than this, in all sequences together, says nothing about its duration."""


def equal_segments(sequences: Sequence[Float[np.ndarray, "_ D"]], n_states: int, floor: float) -> HSMM:
    """Every sequence cut into `n_states` equal parts in time, one state a part, as for the HMM (Sec. V-A)."""
    hmm = em.equal_segments(sequences, n_states, floor)
    means = np.full(n_states, _equal_duration(sequences, n_states))
    return HSMM(
        hmm.initial_probs,
        _without_returns(hmm.transition_matrix),
        hmm.emission_means,
        hmm.emission_covariances,
        means,
        np.maximum(RELATIVE_STD * means, STD_FLOOR),
    )


def em_step(
    hsmm: HSMM,
    sequences: Sequences | Observations,
    floor: float,
    transition_floor: float = TRANSITION_FLOOR,
    prior_segments: float = 1.0,
) -> tuple[HSMM, float]:
    """One iteration of EM. Returns the new model and the log-likelihood of the one that was given.

    `floor` is added to the diagonal of every covariance, once an iteration. Each state's spread of durations counts
    as many as `prior_segments` more segments with `RELATIVE_STD`: a few trials alone make it too small.
    """
    observations = Observations.of(sequences)
    likelihood = log_emission(hsmm, observations.rows)
    transitions, durations = np.zeros(hsmm.transition_matrix.shape), np.zeros(hsmm.log_durations.shape)
    gamma, initial, total, start = np.empty(likelihood.shape), np.zeros(hsmm.n_states), 0.0, 0
    for end in observations.ends:
        rows = slice(start, end)
        log_gamma, log_probability = hsmm.count(likelihood[rows], transitions, durations)
        gamma[rows] = np.exp(log_gamma)
        initial += gamma[start]
        total += log_probability
        start = end
    means, covariances = maximise_emissions(observations, gamma, floor)
    transition = maximise_transitions(transitions, hsmm.transition_matrix, transition_floor)
    initial = np.maximum(initial / len(observations.ends), transition_floor)
    duration_means, duration_stds = maximise_durations(durations, observations.split(), prior_segments)
    new = HSMM(initial / initial.sum(), _without_returns(transition), means, covariances, duration_means, duration_stds)
    return new, total


def maximise_durations(
    counts: Float[np.ndarray, "S longest"], sequences: Sequence[Float[np.ndarray, "_ D"]], prior_segments: float
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """The M-step of the durations: mean and standard deviation [steps] of every state, from expected counts.

    A state that hardly occurs gets the duration of the equal split; one whose end is never seen, at most the length
    of the longest sequence.
    """
    steps = np.arange(1, counts.shape[1] + 1)
    segments = counts.sum(1)
    safe = np.maximum(segments, 1e-12)
    means = np.minimum(counts @ steps / safe, max(map(len, sequences)))
    means = np.where(segments < FEWEST_SEGMENTS, _equal_duration(sequences, len(counts)), means)
    squares = (counts * (steps - means[:, None]) ** 2).sum(1) + prior_segments * (RELATIVE_STD * means) ** 2
    stds = np.sqrt(squares / np.maximum(segments + prior_segments, 1e-12))
    stds = np.where(segments < FEWEST_SEGMENTS, RELATIVE_STD * means, stds)
    return means, np.maximum(stds, STD_FLOOR)


def _equal_duration(sequences: Sequence[Float[np.ndarray, "_ D"]], n_states: int) -> float:
    """How long a state lasts in the equal split [steps]."""
    return max(1.0, float(np.mean([len(sequence) for sequence in sequences])) / n_states)


def _without_returns(transition: Float[np.ndarray, "S S"]) -> Float[np.ndarray, "S S"]:
    """The same transitions, but that no state follows itself, except the last: there an interaction may stay."""
    others = ~np.eye(len(transition), dtype=bool)
    others[-1, -1] = True
    return transition * others / (transition * others).sum(1, keepdims=True)
