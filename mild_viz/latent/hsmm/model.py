"""The hidden semi-Markov model of the earlier MILD (Prasad et al. 2022): states with Gaussian durations.

It is run as a Markov chain over state and elapsed duration, so that it can be filtered one step at a time: a step
costs O(S^2 + S D) for S states and durations of up to D steps. A sequence starts with a segment, and cuts its last
segment off: that segment counts with the probability of lasting at least so long.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from mild_viz.errors import UserError
from mild_viz.latent.hmm import HMM, FilterCarry, check_hmm, safe_log
from mild_viz.latent.hsmm import kernels

CUT = 4.0
"""The longest duration lies so many standard deviations above the mean, for the state where that is most."""

DURATION_RANGE = (1e-3, 1e4)
"""Valid means and standard deviations of a duration [steps]."""


@dataclass(frozen=True, eq=False)
class HSMM(HMM):
    """A hidden Markov model whose states last for explicit durations.

    `transition_matrix[i, j]` is p(j given that a segment of i ended). No state follows itself but the last, which
    thus may be where an interaction stays. `duration_means` and `duration_stds` [steps] are those of a Gaussian on
    1, 2, ... steps, cut off at the longest duration and normalised.
    """

    duration_means: Float[np.ndarray, " S"]
    duration_stds: Float[np.ndarray, " S"]

    @cached_property
    def log_durations(self) -> Float[np.ndarray, "S longest"]:
        """log p(a segment of state i lasts d + 1 steps) at [i, d]; all recursions know the durations from here."""
        longest = max(1, int(np.ceil((self.duration_means + CUT * self.duration_stds).max())))
        deviation = np.arange(1, longest + 1) - self.duration_means[:, None]
        log_density = -0.5 * (deviation / self.duration_stds[:, None]) ** 2
        return log_density - np.logaddexp.reduce(log_density, axis=1, keepdims=True)

    @cached_property
    def log_survival(self) -> Float[np.ndarray, "S longest"]:
        """log p(a segment of state i lasts d + 1 steps or more) at [i, d]."""
        return np.logaddexp.accumulate(self.log_durations[:, ::-1], axis=1)[:, ::-1]

    @cached_property
    def chain(self) -> tuple[Float[np.ndarray, "S S"], Float[np.ndarray, "S longest"], Float[np.ndarray, "S longest"]]:
        """log p(j given that i ended); and log p(the segment goes on), log p(it ends), given d + 1 steps of it."""
        longer = np.concatenate([self.log_survival[:, 1:], np.full((self.n_states, 1), -np.inf)], axis=1)
        reached = np.where(np.isfinite(self.log_survival), self.log_survival, 0.0)
        stay, leave = (np.ascontiguousarray(table - reached) for table in (longer, self.log_durations))
        return self.log_transition, stay, leave

    def beginning(self) -> Float[np.ndarray, "S longest"]:
        """The table over state and elapsed duration at a sequence's first step, before its observation."""
        table = np.full(self.log_durations.shape, -np.inf)
        table[:, 0] = safe_log(self.initial_probs)
        return table

    def filter(
        self, log_likelihood: Float[np.ndarray, "N S"], carry: FilterCarry | None = None
    ) -> tuple[Float[np.ndarray, "N S"], float, FilterCarry]:
        """As for the HMM; what is carried on is over state and elapsed duration (S, longest)."""
        if carry is None:
            table = self.beginning()
        else:
            table = np.empty(self.log_durations.shape)
            kernels.predict(carry, *self.chain, table)
        log_alpha, tables = np.empty(log_likelihood.shape), np.empty((2, *table.shape))
        total = kernels.forward(table, *self.chain, np.ascontiguousarray(log_likelihood), tables, log_alpha)
        return log_alpha, float(total), tables[(len(log_alpha) - 1) % 2]

    def smooth(self, log_likelihood: Float[np.ndarray, "N S"]) -> Float[np.ndarray, "N S"]:
        """log p(state at n given z_{1:N}), by forward-backward."""
        return self.count(log_likelihood, np.zeros(self.transition_matrix.shape), np.zeros(self.log_durations.shape))[0]

    def count(
        self,
        log_likelihood: Float[np.ndarray, "N S"],
        transitions: Float[np.ndarray, "S S"],
        durations: Float[np.ndarray, "S longest"],
    ) -> tuple[Float[np.ndarray, "N S"], float]:
        """log p(state at n given z_{1:N}), and log p(z_{1:N}); expected counts are added to the two tables.

        `transitions[j, i]` counts segments of i after one of j. `durations[i, d]` counts segments of i of d + 1 steps;
        the last segment, which is cut off, counts with the durations that it may come to have.
        """
        log_likelihood = np.ascontiguousarray(log_likelihood)
        reach = min(len(log_likelihood), self.log_durations.shape[1])  # no segment is older than the sequence
        start, stay, leave = (np.ascontiguousarray(table[:, :reach]) for table in (self.beginning(), *self.chain[1:]))
        chain = (self.log_transition, stay, leave)
        tables = np.empty((len(log_likelihood), self.n_states, reach))
        gamma, changes, ended = np.empty(log_likelihood.shape), np.zeros(transitions.shape), np.zeros(durations.shape)
        initial, transition = self.initial_probs.copy(), self.transition_matrix.copy()  # which are read-only
        total = kernels.count_scaled(
            initial, transition, np.exp(stay), np.exp(leave), log_likelihood, tables, gamma, changes, ended
        )
        if np.isnan(total):
            changes[:], ended[:] = 0.0, 0.0
            total = kernels.forward(start, *chain, log_likelihood, tables, np.empty(gamma.shape))
            kernels.backward(tables, *chain, log_likelihood, gamma, changes, ended)
            log_gamma, log_last = gamma, tables[-1]
        else:
            log_gamma, log_last = safe_log(gamma), safe_log(tables[-1])
        # p(D = d given that it lasts e steps or more) p(e), summed over all e up to d.
        cut = np.full(durations.shape, -np.inf)
        np.subtract(log_last, self.log_survival[:, :reach], out=cut[:, :reach], where=np.isfinite(log_last))
        transitions += changes
        durations += ended + np.exp(self.log_durations + np.logaddexp.accumulate(cut, axis=1))
        return log_gamma, float(total)

    def viterbi(self, log_likelihood: Float[np.ndarray, "N S"]) -> tuple[Int[np.ndarray, " N"], float]:
        """States of the most likely segments, and the segments' joint log probability with the observations."""
        path = np.empty(len(log_likelihood), dtype=np.int64)
        score = kernels.viterbi(self.beginning(), *self.chain, np.ascontiguousarray(log_likelihood), path)
        return path, float(score)


def check_hsmm(hsmm: HSMM, where: str) -> HSMM:
    """Return `hsmm` if it is a valid model, else raise an error that says what is wrong."""
    check_hmm(hsmm, where)
    low, high = DURATION_RANGE
    for name in ("duration_means", "duration_stds"):
        values = getattr(hsmm, name)
        if not ((values >= low) & (values <= high)).all():
            raise UserError(f"{where}: {name} are {values} steps; valid: {low:g} to {high:g}")
    returns = np.flatnonzero(np.diagonal(hsmm.transition_matrix)[:-1])
    if len(returns):
        raise UserError(
            f"{where}: transition_matrix lets states {returns.tolist()} follow themselves; "
            "in a model with durations only the last state may"
        )
    return hsmm
