"""Compiled densities and recursions over hidden states. Typed wrappers are in hmm.py and em.py.

Shapes: N steps, S states, D dimensions. `log_transition[j, i]` is log p(i given j); `log_likelihood[n, i]` is
log p(z_n given i), and a row of zeros is a step without an observation.
"""

import numpy as np
from numba import njit

BLOCK = 64
"""Steps that are taken through the densities at a time: they stay in the nearest cache."""

LEAST = 1e-130
"""A scaled probability below this is 0: subnormal numbers would be many times slower."""
LOG_LEAST = np.log(LEAST)

RANGE = 1e30
"""Backward variables may grow to this and scales fall to its inverse; a sequence beyond needs logarithms."""


@njit(cache=True)
def log_density(z, whitening, offsets, constants, result):
    """Fill result[n, i] with constants[i] - |whitening[i] z[n] - offsets[i]|^2 / 2, or 0 if z[n] is not finite.

    `whitening` (S, D, D) is lower triangular. The innermost loops run over steps, so that they are vectorised.
    """
    n_steps, size = z.shape
    columns = np.zeros((size, BLOCK))
    component, distance = np.empty(BLOCK), np.empty(BLOCK)
    seen = np.empty(BLOCK, dtype=np.bool_)
    for start in range(0, n_steps, BLOCK):
        count = min(BLOCK, n_steps - start)
        for n in range(count):
            seen[n] = True
            for d in range(size):
                columns[d, n] = z[start + n, d]
                seen[n] &= np.isfinite(z[start + n, d])
        for i in range(len(constants)):
            distance[:] = 0.0
            for d in range(size):
                component[:] = -offsets[i, d]
                for e in range(d + 1):
                    weight = whitening[i, d, e]
                    for n in range(BLOCK):
                        component[n] += weight * columns[e, n]
                for n in range(BLOCK):
                    distance[n] += component[n] * component[n]
            for n in range(count):
                result[start + n, i] = constants[i] - 0.5 * distance[n] if seen[n] else 0.0


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
def smooth_scaled(initial, transition, log_likelihood, alpha, flow, gamma):
    """Forward-backward over one sequence in probabilities, each step scaled to sum to one; return log p(z_{1:N}).

    Fill `gamma[n, i]` with p(i at n given z_{1:N}), `alpha` with the normalised forward variable (Eq. hmm-h), and
    `flow` such that alpha[n - 1, j] transition[j, i] flow[n, i] is p(j at n - 1, i at n given z_{1:N}); flow[0] is 0.

    A probability below the smallest number becomes 0. No scale below 1 / RANGE and no backward variable above RANGE
    means that what is lost so is below 1 / RANGE in `gamma` too. Otherwise the result is NaN, and the work must be
    done in logarithms.
    """
    n_steps, n_states = log_likelihood.shape
    total = 0.0
    predicted = initial.copy()
    for n in range(n_steps):
        top = log_likelihood[n].max()
        scale = 0.0
        for i in range(n_states):
            relative = log_likelihood[n, i] - top
            flow[n, i] = np.exp(relative) if relative > LOG_LEAST else 0.0  # the likelihood alone, until the way back
            alpha[n, i] = predicted[i] * flow[n, i]
            if alpha[n, i] < LEAST:
                alpha[n, i] = 0.0
            scale += alpha[n, i]
        if not scale >= 1.0 / RANGE:
            return np.nan
        total += top + np.log(scale)
        inverse = 1.0 / scale
        for i in range(n_states):
            alpha[n, i] *= inverse
            flow[n, i] *= inverse
        for i in range(n_states):
            reached = 0.0
            for j in range(n_states):
                reached += alpha[n, j] * transition[j, i]
            predicted[i] = reached
    beta = np.ones(n_states)
    for n in range(n_steps - 1, -1, -1):
        for i in range(n_states):
            gamma[n, i] = alpha[n, i] * beta[i]
            flow[n, i] *= beta[i]
        largest = 0.0
        for j in range(n_states):
            ahead = 0.0
            for i in range(n_states):
                ahead += transition[j, i] * flow[n, i]
            beta[j] = ahead if ahead >= LEAST else 0.0
            largest = max(largest, ahead)
        if not largest <= RANGE:
            return np.nan
    flow[0] = 0.0
    return total


@njit(cache=True)
def smooth_logarithms(initial, transition, log_likelihood, gamma, counts):
    """The same in log space, several times slower: fill `gamma`, add the expected transitions to `counts`."""
    log_transition = np.log(transition)
    log_alpha, log_beta = np.empty(gamma.shape), np.empty(gamma.shape)
    total = forward(np.log(initial), log_transition, log_likelihood, log_alpha)
    backward(log_transition, log_likelihood, log_beta)
    add_transition_counts(log_alpha, log_beta, log_transition, log_likelihood, counts)
    for n in range(len(gamma)):
        log_gamma = log_alpha[n] + log_beta[n]
        gamma[n] = np.exp(log_gamma - _log_sum(log_gamma))
    return total


@njit(cache=True)
def smooth_all(initial, transition, log_likelihood, ends, alpha, flow, gamma, counts):
    """`smooth_scaled` over sequences that lie one after the other and end before the rows `ends`; return log p of all.

    A sequence that needs logarithms has its transitions in `counts`, and zeros in `flow`.
    """
    total, start = 0.0, 0
    for end in ends:
        rows = slice(start, end)
        found = smooth_scaled(initial, transition, log_likelihood[rows], alpha[rows], flow[rows], gamma[rows])
        if np.isnan(found):
            found = smooth_logarithms(initial, transition, log_likelihood[rows], gamma[rows], counts)
            alpha[rows], flow[rows] = 0.0, 0.0
        total += found
        start = end
    return total


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


@njit(cache=True)
def condition_states(human_mean, human_variance, means, covariances, conditional_mean, conditional_covariance):
    """Fill the conditional mean (N, S, R) and covariance (N, S, R, R) of every state for each human posterior (N, H).

    With L the Cholesky factor of the innovation Sigma^hh_i + diag(variance_n), Y = L^-1 Sigma^hr_i and
    w = L^-1 (mean_n - mu^h_i), the mean is mu^r_i + Y^T w and the covariance Sigma^rr_i - Y^T Y.
    """
    n_steps, size = human_mean.shape
    width = means.shape[1] - size + 1
    factor, solved = np.empty((size, size)), np.empty((size, width))
    for n in range(n_steps):
        for i in range(len(means)):
            mean, covariance = means[i], covariances[i]
            for a in range(size):
                for b in range(a):
                    value = covariance[a, b]
                    for c in range(b):
                        value -= factor[a, c] * factor[b, c]
                    factor[a, b] = value * factor[b, b]
                value = covariance[a, a] + human_variance[n, a]
                for c in range(a):
                    value -= factor[a, c] * factor[a, c]
                factor[a, a] = 1.0 / np.sqrt(value)  # the inverse, for it is only divided by
                for r in range(width):  # the columns of Y, then w
                    value = covariance[a, size + r] if r < width - 1 else human_mean[n, a] - mean[a]
                    for c in range(a):
                        value -= factor[a, c] * solved[c, r]
                    solved[a, r] = value * factor[a, a]
            for r in range(width - 1):
                value = mean[size + r]
                for c in range(size):
                    value += solved[c, r] * solved[c, width - 1]
                conditional_mean[n, i, r] = value
                for q in range(r + 1):
                    value = covariance[size + r, size + q]
                    for c in range(size):
                        value -= solved[c, r] * solved[c, q]
                    conditional_covariance[n, i, r, q] = conditional_covariance[n, i, q, r] = value
