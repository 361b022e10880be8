"""Expectation-maximisation for the Gaussian HMM: compiled forward-backward, statistics as matrix products."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from mild_viz.latent import kernels
from mild_viz.latent.hmm import HMM, log_emission, observed_rows

TRANSITION_FLOOR = 1e-6
"""Smallest transition probability: a state that was never left can still be left."""

DEAD_STATE_STEPS = 2.0
"""A state that explains fewer steps than this has died and is placed anew."""

LOST_DIGITS = 1e-8
"""A variance below this part of the second moment that it is the rest of is computed anew."""

Sequences = Sequence[Float[np.ndarray, "_ D"]]


def equal_segments(sequences: Sequence[Float[np.ndarray, "_ D"]], n_states: int, floor: float) -> HMM:
    """The paper's start: every sequence cut into `n_states` equal parts in time, one state a part (Sec. V-A)."""
    size = sequences[0].shape[1]
    parts = [[] for _ in range(n_states)]
    for sequence in sequences:
        for state, part in enumerate(np.array_split(sequence, n_states)):
            parts[state].append(part[observed_rows(part)])
    pooled = [np.concatenate(part) for part in parts]
    everything = np.concatenate(pooled)
    # A part of which nothing was observed knows no better than the whole.
    pooled = [part if len(part) else everything for part in pooled]
    stay = max(0.01, 1.0 - n_states / np.mean([len(sequence) for sequence in sequences]))
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


@dataclass(frozen=True, eq=False)
class Observations:
    """Sequences that lie one after the other, and what the M-step needs of them in every iteration alike."""

    rows: Float[np.ndarray, "N D"]
    ends: Int[np.ndarray, " Q"]
    """The row after the last one of each sequence."""
    centre: Float[np.ndarray, " D"]
    """The mean of all rows, from which the moments are taken so that they keep their digits."""
    moments: Float[np.ndarray, "N M"]
    """Per row 1, z and the lower triangle of z z^T, seen from the centre: their weighted sums are one matrix product.

    Zero where a step has no observation: it carries the recursion on but says nothing about the emissions.
    """

    @classmethod
    def of(cls, sequences: Sequences | Observations) -> Observations:
        """Prepare sequences, once for all iterations on them."""
        if isinstance(sequences, Observations):
            return sequences
        rows = np.concatenate(sequences)
        seen = observed_rows(rows)
        centre = rows[seen].mean(0)
        centred = (rows - centre).T
        lower, upper = np.tril_indices(len(centred))
        moments = np.concatenate([np.ones((1, len(rows))), centred, centred[lower] * centred[upper]])
        moments[:, ~seen] = 0.0
        return cls(rows, np.cumsum([len(sequence) for sequence in sequences]), centre, moments.T)

    def split(self) -> list[Float[np.ndarray, "_ D"]]:
        """The sequences, one by one."""
        return np.split(self.rows, self.ends[:-1])


class Expectation(NamedTuple):
    """What the E-step finds: the posterior of the hidden states, given every sequence whole."""

    gamma: Float[np.ndarray, "N S"]
    """p(state at n given z_{1:N}), the rows of all sequences one after the other."""
    transitions: Float[np.ndarray, "S S"]
    """Expected number of transitions j -> i at [j, i], over all sequences."""
    initial: Float[np.ndarray, " S"]
    """Expected number of sequences that start in each state."""
    log_likelihood: float


def expectation(hmm: HMM, sequences: Sequences | Observations) -> Expectation:
    """The E-step of EM: forward-backward over every sequence."""
    observations = Observations.of(sequences)
    likelihood = log_emission(hmm, observations.rows)
    alpha, flow, gamma = (np.empty(likelihood.shape) for _ in range(3))
    counts = np.zeros((hmm.n_states, hmm.n_states))
    total = kernels.smooth_all(
        hmm.initial_probs, hmm.transition_matrix, likelihood, observations.ends, alpha, flow, gamma, counts
    )
    counts += hmm.transition_matrix * (alpha[:-1].T @ flow[1:])
    starts = np.append(0, observations.ends[:-1])
    return Expectation(gamma, counts, gamma[starts].sum(0), total)


def maximise_emissions(
    sequences: Sequences | Observations, gamma: Float[np.ndarray, "N S"], floor: float
) -> tuple[Float[np.ndarray, "S D"], Float[np.ndarray, "S D D"]]:
    """The M-step of the Gaussians: means and covariances of every state, each step weighted by `gamma`.

    A state that explains next to nothing is placed anew. `floor` is added to the diagonal of every covariance.
    """
    observations = Observations.of(sequences)
    n_states, size = gamma.shape[1], observations.rows.shape[1]
    moments = gamma.T @ observations.moments
    mass = moments[:, 0]
    moments = moments / np.maximum(mass, 1e-12)[:, None]
    offset = moments[:, 1 : 1 + size]
    lower, upper = np.tril_indices(size)
    second = np.empty((n_states, size, size))
    second[:, lower, upper] = second[:, upper, lower] = moments[:, 1 + size :]
    means, covariances = observations.centre + offset, second - offset[:, :, None] * offset[:, None, :]
    # The difference has lost its digits where a state is small beside its distance from the centre.
    variance, power = (np.diagonal(matrix, axis1=1, axis2=2) for matrix in (covariances, second))
    for state in np.flatnonzero((variance < LOST_DIGITS * power.max(1, keepdims=True)).any(1)):
        centred = np.nan_to_num(observations.rows - means[state])
        weights = gamma[:, state] * observations.moments[:, 0]
        covariances[state] = (weights[:, None] * centred).T @ centred / max(mass[state], 1e-12)
    dead = mass < DEAD_STATE_STEPS
    if dead.any():
        # Placed where the equal split in time would have put it, so that the order of states survives.
        fresh = equal_segments(observations.split(), n_states, 0.0)
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
    sequences: Sequences | Observations,
    floor: float,
    transition_floor: float = TRANSITION_FLOOR,
) -> tuple[HMM, float]:
    """One iteration of EM. Returns the new model and the log-likelihood of the one that was given.

    `floor` is added to the diagonal of every covariance (the paper's regularisation), once an iteration.
    """
    observations = Observations.of(sequences)
    found = expectation(hmm, observations)
    means, covariances = maximise_emissions(observations, found.gamma, floor)
    transition = maximise_transitions(found.transitions, hmm.transition_matrix, transition_floor)
    initial = np.maximum(found.initial / len(observations.ends), transition_floor)
    return HMM(initial / initial.sum(), transition, means, covariances), found.log_likelihood


def fit(
    hmm: HMM,
    sequences: Sequences,
    floor: float,
    n_iterations: int,
    tolerance: float = 1e-3,
    transition_floor: float = TRANSITION_FLOOR,
    step: Callable[[Any, Observations, float, float], tuple[HMM, float]] = em_step,
) -> tuple[HMM, list[float]]:
    """EM from a start until the log-likelihood per step rises by less than `tolerance`, or `n_iterations`.

    `step` is one iteration for the start's kind of model. Returns the model and the log-likelihood before every
    iteration.
    """
    observations = Observations.of(sequences)
    history: list[float] = []
    for _ in range(n_iterations):
        hmm, total = step(hmm, observations, floor, transition_floor)
        converged = bool(history) and abs(total - history[-1]) < tolerance * len(observations.rows)
        history.append(total)
        if converged:
            break
    return hmm, history
