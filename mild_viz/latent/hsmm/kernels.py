"""Compiled recursions over states and the time spent in them. Typed wrappers are in model.py.

Shapes: N steps, S states, D steps of the longest duration. A table [i, d] is over state i with d steps of its segment
before this one; `log_stay[i, d]` and `log_leave[i, d]` are the log probabilities that the segment goes on, or ends
here. `log_transition[j, i]` is log p(i given that j ended); `log_likelihood` is as in latent/kernels.py.
"""

import numpy as np
from numba import njit

NEGLIGIBLE = 45.0
"""A term of a sum that is smaller than the largest by a factor of e^-45 does not reach the last bit of a float64."""

RANGE = 1e100
"""Scaled probabilities may grow to this and their scales fall to its inverse; a sequence beyond needs logarithms."""


@njit(cache=True)
def _log_sum(values):
    top = values.max()
    if top == -np.inf:
        return top
    total = 0.0
    for value in values:
        if value > top - NEGLIGIBLE:
            total += np.exp(value - top)
    return top + np.log(total)


@njit(cache=True)
def _log_add(a, b):
    high, low = max(a, b), min(a, b)
    return high + np.log1p(np.exp(low - high)) if low > high - NEGLIGIBLE else high


@njit(cache=True)
def predict(table, log_transition, log_stay, log_leave, following):
    """Fill `following` with the table one step later, before its observation."""
    n_states, longest = table.shape
    ended = np.empty(n_states)
    for j in range(n_states):
        ended[j] = _log_sum(table[j] + log_leave[j])
    for i in range(n_states):
        following[i, 0] = _log_sum(ended + log_transition[:, i])
        for d in range(longest - 1):
            following[i, d + 1] = table[i, d] + log_stay[i, d]


@njit(cache=True)
def forward(prior, log_transition, log_stay, log_leave, log_likelihood, tables, log_alpha):
    """Fill `log_alpha` with the normalised forward variable and `tables` with its tables; return log p(z_{1:N}).

    `prior` is the table at the first step, before its observation. Step n is kept in `tables[n % len(tables)]`: give
    N tables to keep all, or two to keep the last.
    """
    n_steps, n_states = log_likelihood.shape
    total = 0.0
    for n in range(n_steps):
        table = tables[n % len(tables)]
        if n == 0:
            table[:] = prior
        else:
            predict(tables[(n - 1) % len(tables)], log_transition, log_stay, log_leave, table)
        for i in range(n_states):
            log_alpha[n, i] = _log_sum(table[i]) + log_likelihood[n, i]
        norm = _log_sum(log_alpha[n])
        total += norm
        for i in range(n_states):
            log_alpha[n, i] -= norm
            table[i] += log_likelihood[n, i] - norm
    return total


@njit(cache=True)
def backward(tables, log_transition, log_stay, log_leave, log_likelihood, log_gamma, counts, ended):
    """The way back over all `tables` of `forward`.

    Fill `log_gamma[n, i]` with log p(i at n given z_{1:N}); add the expected number of transitions j -> i to
    `counts[j, i]`, and of segments of state i that end after d + 1 steps to `ended[i, d]`. The last segment, whose
    end is not seen, is in neither.
    """
    n_steps, n_states, longest = tables.shape
    log_beta = np.zeros((n_states, longest))
    begin, leave = np.empty(n_states), np.empty(n_states)
    joint = np.empty((n_states, longest))
    for n in range(n_steps - 1, -1, -1):
        reach = min(longest, n + 1)  # no segment is older than the sequence
        if n < n_steps - 1:
            # log_beta is that of step n + 1 here, and becomes that of step n.
            for i in range(n_states):
                begin[i] = log_likelihood[n + 1, i] + log_beta[i, 0]
            for i in range(n_states):
                leave[i] = _log_sum(log_transition[i] + begin)
                for d in range(reach):
                    stay = log_stay[i, d]
                    if d + 1 < longest:
                        stay += log_likelihood[n + 1, i] + log_beta[i, d + 1]
                    log_beta[i, d] = _log_add(stay, log_leave[i, d] + leave[i])
        for i in range(n_states):
            joint[i, :reach] = tables[n, i, :reach] + log_beta[i, :reach]
            log_gamma[n, i] = _log_sum(joint[i, :reach])
        norm = _log_sum(log_gamma[n])
        log_gamma[n] -= norm
        if n < n_steps - 1:
            for j in range(n_states):
                over = 0.0
                for d in range(reach):
                    value = tables[n, j, d] + log_leave[j, d] + leave[j] - norm
                    if value > -NEGLIGIBLE:
                        ended[j, d] += np.exp(value)
                        over += np.exp(value)
                if over > 0.0:
                    for i in range(n_states):
                        counts[j, i] += over * np.exp(log_transition[j, i] + begin[i] - leave[j])
        # The tables are normalised, so that this keeps the backward variable near one.
        log_beta[:, :reach] -= norm


@njit(cache=True, fastmath={"reassoc"})  # sums in any order, so that they are vectorised
def count_scaled(initial, transition, stay, leave, log_likelihood, tables, gamma, counts, ended):
    """`forward` and `backward` in probabilities, each step scaled to sum to one: many times faster.

    All arguments but `log_likelihood` are probabilities; `tables` has N steps. Returns log p(z_{1:N}), or NaN where
    numbers leave `RANGE`: the work must then be done in logarithms, and what was filled in be thrown away. A number
    below the smallest becomes 0, which within `RANGE` changes `gamma` by less than 1 / RANGE.
    """
    n_steps, n_states = log_likelihood.shape
    longest = stay.shape[1]
    total, entering = 0.0, initial.copy()
    weight = np.empty((n_steps, n_states))  # the likelihood over the step's scale
    for n in range(n_steps):
        top, scale, reach = log_likelihood[n].max(), 0.0, min(longest, n + 1)
        for i in range(n_states):
            weight[n, i] = np.exp(log_likelihood[n, i] - top)
            tables[n, i, 0] = entering[i] * weight[n, i]
            for d in range(1, reach):
                tables[n, i, d] = tables[n - 1, i, d - 1] * stay[i, d - 1] * weight[n, i]
            for d in range(reach):
                scale += tables[n, i, d]
        if not scale >= 1.0 / RANGE:
            return np.nan
        total += top + np.log(scale)
        entering[:] = 0.0
        for j in range(n_states):
            weight[n, j] /= scale
            left = 0.0
            for d in range(reach):
                tables[n, j, d] /= scale
                left += tables[n, j, d] * leave[j, d]
            for i in range(n_states):
                entering[i] += left * transition[j, i]

    beta = np.ones((n_states, longest))
    for n in range(n_steps - 1, -1, -1):
        reach = min(longest, n + 1)
        if n < n_steps - 1:
            begin = weight[n + 1] * beta[:, 0]  # beta is that of step n + 1 here, and becomes that of step n
            for i in range(n_states):
                flow, left = 0.0, 0.0
                for j in range(n_states):
                    flow += transition[i, j] * begin[j]
                for d in range(reach):
                    ending = tables[n, i, d] * leave[i, d]
                    left += ending
                    ended[i, d] += ending * flow
                for j in range(n_states):
                    counts[i, j] += left * transition[i, j] * begin[j]
                for d in range(min(reach, longest - 1)):
                    beta[i, d] = stay[i, d] * weight[n + 1, i] * beta[i, d + 1] + leave[i, d] * flow
                if reach == longest:
                    beta[i, longest - 1] = leave[i, longest - 1] * flow
        peak = 0.0
        for i in range(n_states):
            gamma[n, i] = 0.0
            for d in range(reach):
                gamma[n, i] += tables[n, i, d] * beta[i, d]
                peak += beta[i, d]
        if not peak <= RANGE:
            return np.nan
    return total


@njit(cache=True)
def viterbi(prior, log_transition, log_stay, log_leave, log_likelihood, path):
    """Fill `path` with the states of the most likely segments; return their joint log probability."""
    n_steps, n_states = log_likelihood.shape
    longest = prior.shape[1]
    score, following = prior.copy(), np.empty((n_states, longest))
    origin = np.zeros((n_steps, n_states), dtype=np.int64)  # the state before a segment that starts here,
    length = np.zeros((n_steps, n_states), dtype=np.int64)  # and for how many steps it lasted
    ended, lasted = np.empty(n_states), np.empty(n_states, dtype=np.int64)
    for n in range(n_steps):
        if n > 0:
            for j in range(n_states):
                end = score[j] + log_leave[j]
                lasted[j] = np.argmax(end)
                ended[j] = end[lasted[j]]
            for i in range(n_states):
                start = ended + log_transition[:, i]
                origin[n, i] = np.argmax(start)
                length[n, i] = lasted[origin[n, i]] + 1
                following[i, 0] = start[origin[n, i]]
                following[i, 1:] = score[i, :-1] + log_stay[i, :-1]
            score, following = following, score
        for i in range(n_states):
            score[i] += log_likelihood[n, i]
    best = np.argmax(score)
    state, steps = best // longest, best % longest + 1
    end = n_steps
    while True:
        path[end - steps : end] = state
        end -= steps
        if end == 0:
            return score.max()
        state, steps = origin[end, state], length[end, state]
