"""Gaussian mixture regression: the robot's latent given the human's (Eqs. gmr-* and conditioning-withcov-*)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mild_viz.latent.hmm import HMM


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
    mean_h, mean_r = hmm.emission_means[:, :size], hmm.emission_means[:, size:]
    cov_hh = hmm.emission_covariances[:, :size, :size]
    cov_rh = hmm.emission_covariances[:, size:, :size]
    cov_rr = hmm.emission_covariances[:, size:, size:]
    observed = ~np.isnan(human_mean).any(1)
    weights = np.exp(log_alpha)
    deviation = np.where(observed[:, None, None], human_mean[:, None, :] - mean_h, 0.0)  # N S H

    if human_std is None:
        gain = np.linalg.solve(cov_hh, cov_rh.transpose(0, 2, 1)).transpose(0, 2, 1)  # S R H
        means = mean_r + np.einsum("srh,nsh->nsr", gain, deviation)
        reduction = gain @ cov_rh.transpose(0, 2, 1)
        within = np.einsum("ns,sab->nab", weights, cov_rr)
        within -= np.einsum("ns,sab->nab", weights * observed[:, None], reduction)
    else:
        posterior = np.zeros((len(human_mean), 1, size, size))
        posterior[:, 0, range(size), range(size)] = np.where(observed[:, None], human_std, 0.0) ** 2
        gain = np.linalg.solve(
            cov_hh + posterior,
            np.broadcast_to(cov_rh.transpose(0, 2, 1), (len(human_mean), *cov_rh.transpose(0, 2, 1).shape)),
        )
        gain = gain.transpose(0, 1, 3, 2)  # N S R H
        means = mean_r + (gain @ deviation[..., None])[..., 0]
        reduction = (gain @ cov_rh.transpose(0, 2, 1)) * observed[:, None, None, None]
        within = np.einsum("ns,nsab->nab", weights, cov_rr - reduction)

    mean = np.einsum("ns,nsr->nr", weights, means)
    # Eq. gmr-conditioning-sigma-t, with the spread of the means taken about their mixture mean: the same
    # number as the difference of second moments, without its cancellation.
    spread = means - mean[:, None, :]
    covariance = within + np.einsum("ns,nsa,nsb->nab", weights, spread, spread)
    return mean, 0.5 * (covariance + covariance.transpose(0, 2, 1))
