"""Compiled recursions over hidden states, in log space. Typed wrappers are in hmm.py and em.py.

Shapes: N steps, S states. `log_transition[j, i]` is log p(i given j); `log_likelihood[n, i]` is
log p(z_n given i), and a row of zeros is a step without an observation.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def _log_sum(values):
    top = values.max()
    if top == -np.inf:
        return top
    total = 0.0
    for value in values:
        total += np.exp(value - top)
    return top + np.log(total)


@njit(cache=True)
def forward(log_prior, log_transition, log_likelihood, log_alpha):
    """Fill `log_alpha` with the normalised forward variable (Eq. hmm-h); return log p(z_{1:N}).

    `log_prior` is the log probability of the states at the first step, before its observation.
    """
    n_steps, n_states = log_likelihood.shape
    scratch = np.empty(n_states)
    total = 0.0
    for n in range(n_steps):
        for i in range(n_states):
            if n == 0:
                log_alpha[0, i] = log_prior[i] + log_likelihood[0, i]
            else:
                for j in range(n_states):
                    scratch[j] = log_alpha[n - 1, j] + log_transition[j, i]
                log_alpha[n, i] = _log_sum(scratch) + log_likelihood[n, i]
        norm = _log_sum(log_alpha[n])
        total += norm
        for i in range(n_states):
            log_alpha[n, i] -= norm
    return total


@njit(cache=True)
def backward(log_transition, log_likelihood, log_beta):
    """Fill `log_beta` with the backward variable, each row shifted to log-sum zero."""
    n_steps, n_states = log_likelihood.shape
    scratch = np.empty(n_states)
    log_beta[n_steps - 1] = -np.log(n_states)
    for n in range(n_steps - 2, -1, -1):
        for j in range(n_states):
            for i in range(n_states):
                scratch[i] = log_transition[j, i] + log_likelihood[n + 1, i] + log_beta[n + 1, i]
            log_beta[n, j] = _log_sum(scratch)
        log_beta[n] -= _log_sum(log_beta[n])


@njit(cache=True)
def add_transition_counts(log_alpha, log_beta, log_transition, log_likelihood, counts):
    """Add the expected number of transitions j -> i to `counts[j, i]`."""
    n_steps, n_states = log_likelihood.shape
    pair = np.empty((n_states, n_states))
    for n in range(n_steps - 1):
        for j in range(n_states):
            for i in range(n_states):
                pair[j, i] = log_alpha[n, j] + log_transition[j, i] + log_likelihood[n + 1, i] + log_beta[n + 1, i]
        top = pair.max()
        total = 0.0
        for j in range(n_states):
            for i in range(n_states):
                pair[j, i] = np.exp(pair[j, i] - top)
                total += pair[j, i]
        for j in range(n_states):
            for i in range(n_states):
                counts[j, i] += pair[j, i] / total


@njit(cache=True)
def viterbi(log_prior, log_transition, log_likelihood, path):
    """Fill `path` with the most likely state sequence; return its joint log probability."""
    n_steps, n_states = log_likelihood.shape
    score = log_prior + log_likelihood[0]
    origin = np.zeros((n_steps, n_states), dtype=np.int64)
    for n in range(1, n_steps):
        following = np.empty(n_states)
        for i in range(n_states):
            best = 0
            for j in range(1, n_states):
                if score[j] + log_transition[j, i] > score[best] + log_transition[best, i]:
                    best = j
            origin[n, i] = best
            following[i] = score[best] + log_transition[best, i] + log_likelihood[n, i]
        score = following
    path[n_steps - 1] = np.argmax(score)
    for n in range(n_steps - 1, 0, -1):
        path[n - 1] = origin[n, path[n]]
    return score.max()
