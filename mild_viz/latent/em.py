"""Expectation-maximisation for the Gaussian HMM: compiled forward-backward, statistics as matrix products."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.latent import kernels
from mild_viz.latent.hmm import HMM, forward_filter, log_emission, observed_rows

TRANSITION_FLOOR = 1e-6
"""Smallest transition probability: a state that was never left can still be left."""

DEAD_STATE_STEPS = 2.0
"""A state that explains fewer steps than this has died and is placed anew."""


def equal_segments(sequences: Sequence[Float[np.ndarray, "_ D"]], n_states: int, floor: float) -> HMM:
    """The paper's start: every sequence cut into `n_states` equal parts in time, one state a part (Sec. V-A)."""
    size = sequences[0].shape[1]
    parts = [[] for _ in range(n_states)]
    for sequence in sequences:
        for state, part in enumerate(np.array_split(sequence, n_states)):
            parts[state].append(part[observed_rows(part)])
    pooled = [np.concatenate(part) for part in parts]
    stay = 1.0 - n_states / np.mean([len(sequence) for sequence in sequences])
    transition = np.full((n_states, n_states), TRANSITION_FLOOR)
    for state in range(n_states - 1):
        transition[state, state] = stay
        transition[state, state + 1] = 1.0 - stay
    transition[-1, -1] = 1.0
    initial = np.full(n_states, TRANSITION_FLOOR)
    initial[0] = 1.0
    return HMM(
        initial / initial.sum(),
        transition / transition.sum(1, keepdims=True),
        np.stack([part.mean(0) for part in pooled]),
        np.stack([np.cov(part.T, bias=True).reshape(size, size) + floor * np.eye(size) for part in pooled]),
    )


class Expectation(NamedTuple):
    """What the E-step finds: the posterior of the hidden states, given every sequence whole."""

    gamma: Float[np.ndarray, "N S"]
    """p(state at n given z_{1:N}), the rows of all sequences one after the other."""
    transitions: Float[np.ndarray, "S S"]
    """Expected number of transitions j -> i at [j, i], over all sequences."""
    initial: Float[np.ndarray, " S"]
    """Expected number of sequences that start in each state."""
    log_likelihood: float


def expectation(hmm: HMM, sequences: Sequence[Float[np.ndarray, "_ D"]]) -> Expectation:
    """The E-step of EM: forward-backward over every sequence."""
    n_states = hmm.n_states
    stacked = np.concatenate(sequences)
    likelihood = log_emission(hmm, stacked)
    gamma = np.empty((len(stacked), n_states))
    counts = np.zeros((n_states, n_states))
    initial = np.zeros(n_states)
    total, start = 0.0, 0
    for sequence in sequences:
        rows = slice(start, start + len(sequence))
        log_alpha, log_probability = forward_filter(hmm, likelihood[rows])
        log_beta = np.empty_like(log_alpha)
        kernels.backward(hmm.log_transition, likelihood[rows], log_beta)
        kernels.add_transition_counts(log_alpha, log_beta, hmm.log_transition, likelihood[rows], counts)
        log_gamma = log_alpha + log_beta
        log_gamma -= log_gamma.max(1, keepdims=True)
        weights = np.exp(log_gamma)
        gamma[rows] = weights / weights.sum(1, keepdims=True)
        initial += gamma[start]
        total += log_probability
        start += len(sequence)
    return Expectation(gamma, counts, initial, total)


def maximise_emissions(
    sequences: Sequence[Float[np.ndarray, "_ D"]], gamma: Float[np.ndarray, "N S"], floor: float
) -> tuple[Float[np.ndarray, "S D"], Float[np.ndarray, "S D D"]]:
    """The M-step of the Gaussians: means and covariances of every state, each step weighted by `gamma`.

    A state that explains next to nothing is placed anew. `floor` is added to the diagonal of every covariance.
    """
    stacked = np.concatenate(sequences)
    n_states, size = gamma.shape[1], stacked.shape[1]
    # Steps without an observation carry the recursion on but say nothing about the emissions.
    seen = observed_rows(stacked)
    stacked, gamma = stacked[seen], gamma[seen]
    mass = gamma.sum(0)
    safe_mass = np.maximum(mass, 1e-12)
    means = (gamma.T @ stacked) / safe_mass[:, None]
    covariances = np.empty((n_states, size, size))
    for state in range(n_states):
        centred = stacked - means[state]
        covariances[state] = (gamma[:, state, None] * centred).T @ centred / safe_mass[state]
    dead = mass < DEAD_STATE_STEPS
    if dead.any():
        # Placed where the equal split in time would have put it, so that the order of states survives.
        fresh = equal_segments(sequences, n_states, 0.0)
        means[dead], covariances[dead] = fresh.emission_means[dead], fresh.emission_covariances[dead]
    return means, covariances + floor * np.eye(size)


def maximise_transitions(
    counts: Float[np.ndarray, "S S"], previous: Float[np.ndarray, "S S"], floor: float = TRANSITION_FLOOR
) -> Float[np.ndarray, "S S"]:
    """The M-step of the transitions: probabilities from expected counts, a row that counts nothing as in `previous`."""
    left = counts.sum(1, keepdims=True)
    transition = np.where(left > 0, np.maximum(counts, 0.0) / np.maximum(left, 1e-300), previous)
    transition = np.maximum(transition, floor)
    return transition / transition.sum(1, keepdims=True)


def em_step(
    hmm: HMM,
    sequences: Sequence[Float[np.ndarray, "_ D"]],
    floor: float,
    transition_floor: float = TRANSITION_FLOOR,
) -> tuple[HMM, float]:
    """One iteration of EM. Returns the new model and the log-likelihood of the one that was given.

    `floor` is added to the diagonal of every covariance (the paper's regularisation), once an iteration.
    """
    found = expectation(hmm, sequences)
    means, covariances = maximise_emissions(sequences, found.gamma, floor)
    transition = maximise_transitions(found.transitions, hmm.transition_matrix, transition_floor)
    initial = np.maximum(found.initial / len(sequences), transition_floor)
    return HMM(initial / initial.sum(), transition, means, covariances), found.log_likelihood


def fit(
    hmm: HMM,
    sequences: Sequence[Float[np.ndarray, "_ D"]],
    floor: float,
    n_iterations: int,
    tolerance: float = 1e-3,
    step: Callable[[Any, Sequence[np.ndarray], float], tuple[HMM, float]] = em_step,
) -> tuple[HMM, list[float]]:
    """EM from a start until the log-likelihood per step rises by less than `tolerance`, or `n_iterations`.

    `step` is one iteration for the start's kind of model. Returns the model and the log-likelihood before every
    iteration.
    """
    n_steps = sum(map(len, sequences))
    history: list[float] = []
    for _ in range(n_iterations):
        hmm, total = step(hmm, sequences, floor)
        converged = bool(history) and abs(total - history[-1]) < tolerance * n_steps
        history.append(total)
        if converged:
            break
    return hmm, history
