"""Gaussian mixture regression: the robot's latent given the human's (Eqs. gmr-* and conditioning-withcov-*)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.latent import kernels
from mild_viz.latent.hmm import HMM, observed_rows


class Regression(NamedTuple):
    """What conditioning without a posterior covariance needs of a model: it does not depend on the observation."""

    gain: Float[np.ndarray, "S R H"]
    """K_i of Eq. gmr-conditioning-K-i."""
    offset: Float[np.ndarray, "S R"]
    """Such that the conditional mean of state i is offset_i + K_i z."""
    covariance: Float[np.ndarray, "S R R"]
    """Sigma^rr_i - K_i Sigma^hr_i."""


@lru_cache(maxsize=64)  # a stream conditions the same model on one observation after the other
def regression(hmm: HMM, size: int) -> Regression:
    """The regression of the robot's latent dimensions on the first `size`, the human's, for every state."""
    cov_rh = hmm.emission_covariances[:, size:, :size]
    cov_hr = cov_rh.transpose(0, 2, 1)
    gain = np.linalg.solve(hmm.emission_covariances[:, :size, :size], cov_hr).transpose(0, 2, 1)
    offset = hmm.emission_means[:, size:] - (gain @ hmm.emission_means[:, :size, None])[..., 0]
    return Regression(gain, offset, hmm.emission_covariances[:, size:, size:] - gain @ cov_hr)


def condition(
    hmm: HMM,
    human_mean: Float[np.ndarray, "N H"],
    log_alpha: Float[np.ndarray, "N S"],
    human_std: Float[np.ndarray, "N H"] | None = None,
) -> tuple[Float[np.ndarray, "N R"], Float[np.ndarray, "N R R"]]:
    """Mean and covariance of p(z_r given the human posterior), for every step.

    The first H latent dimensions of `hmm` are the human's. With `human_std`, the posterior's covariance
    enters the gain (Eq. conditioning-withcov-K-i); without it, the gain is that of Eq. gmr-conditioning-K-i.
    A step whose `human_mean` is NaN has no observation: its gain is zero, and the mixture of the states'
    own Gaussians remains.
    """
    size = human_mean.shape[1]
    weights = np.exp(log_alpha)
    seen = observed_rows(human_mean)
    if human_std is None:
        gain, offset, covariances = regression(hmm, size)
        means = (human_mean @ gain.reshape(-1, size).T).reshape(-1, *offset.shape) + offset
        within = _mix(weights, covariances)
    else:
        means, covariances = _condition_on_posterior(hmm, human_mean, human_std)
        within = (weights[:, None, :] @ covariances.reshape(*weights.shape, -1)).reshape(covariances[:, 0].shape)
    if not seen.all():
        means[~seen] = hmm.emission_means[:, size:]
        within[~seen] = _mix(weights[~seen], hmm.emission_covariances[:, size:, size:])
    return _moments(weights, means, within)


def mix_states(
    weights: Float[np.ndarray, "N S"], means: Float[np.ndarray, "N S R"], covariances: Float[np.ndarray, "N S R R"]
) -> tuple[Float[np.ndarray, "N R"], Float[np.ndarray, "N R R"]]:
    """Mean and covariance of a mixture of Gaussians, for every step (Eqs. gmr-conditioning-mu-t and -sigma-t)."""
    within = (weights[:, None, :] @ covariances.reshape(*weights.shape, -1)).reshape(covariances[:, 0].shape)
    return _moments(weights, means, within)


def _moments(
    weights: Float[np.ndarray, "N S"], means: Float[np.ndarray, "N S R"], within: Float[np.ndarray, "N R R"]
) -> tuple[Float[np.ndarray, "N R"], Float[np.ndarray, "N R R"]]:
    """Mean and covariance of a mixture from the states' means and the mean of their covariances.

    The spread of the means is taken about their mixture mean: the same number as the difference of second moments
    in Eq. gmr-conditioning-sigma-t, without its cancellation.
    """
    mean = (weights[:, None, :] @ means)[:, 0]
    spread = means - mean[:, None, :]
    covariance = within + (weights[..., None] * spread).transpose(0, 2, 1) @ spread
    return mean, 0.5 * (covariance + covariance.transpose(0, 2, 1))


def _condition_on_posterior(
    hmm: HMM, human_mean: Float[np.ndarray, "N H"], human_std: Float[np.ndarray, "N H"]
) -> tuple[Float[np.ndarray, "N S R"], Float[np.ndarray, "N S R R"]]:
    """Conditional mean and covariance of every state (Eqs. conditioning-withcov-K-i and -mu-i); NaN where not seen."""
    robot_size = hmm.emission_means.shape[1] - human_mean.shape[1]
    means = np.empty((len(human_mean), hmm.n_states, robot_size))
    covariances = np.empty((*means.shape, robot_size))
    kernels.condition_states(
        np.ascontiguousarray(human_mean), human_std**2, hmm.emission_means, hmm.emission_covariances, means, covariances
    )
    return means, covariances


def _mix(weights: Float[np.ndarray, "N S"], covariances: Float[np.ndarray, "S R R"]) -> Float[np.ndarray, "N R R"]:
    """Weighted sums of the states' covariances."""
    return (weights @ covariances.reshape(len(covariances), -1)).reshape(-1, *covariances.shape[1:])
