"""Whether the predictive covariance says the truth: coverage of its ellipsoids, and the energy score.

The prediction of a window is N(partner_mean, partner_covariance) in latent space (Eqs. conditioning-withcov-mu-t
and -sigma-t); the truth is the recorded partner's window, encoded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from mild_viz.evaluation.passes import Pass

LEVELS = (0.5, 0.9)
"""Probabilities of the ellipsoids and intervals."""

N_SAMPLES = 100
"""Samples of every window's prediction; averaged over hundreds of windows, the scores' third digit stands."""


@dataclass(frozen=True)
class Calibration:
    """Over the complete windows of some trials. Shares are of 1; a calibrated prediction has `LEVELS`."""

    n_windows: int
    coverage: tuple[float, ...]
    """Share of true latents within the ellipsoid of each of `LEVELS`."""
    energy: float
    """Energy score in latent space (smaller is better)."""
    energy_point: float
    """The same of the mean alone, that is its distance from the truth: a covariance that helps is below it."""
    decoded_coverage: tuple[float, ...]
    """Share of true joints (positions, between humans) within the central interval of decoded samples."""
    decoded_energy: float
    """Energy score of the decoded first frame [rad; m between humans]."""
    decoded_point: float
    """Distance of the decoded mean's first frame from the truth [rad; m]."""


def mahalanobis_squared(
    mean: Float[np.ndarray, "N D"], covariance: Float[np.ndarray, "N D D"], truth: Float[np.ndarray, "N D"]
) -> Float[np.ndarray, " N"]:
    """(z - mu)' Sigma^-1 (z - mu) of every row: chi-square with D degrees of freedom if the prediction is right."""
    difference = truth - mean
    return (difference * np.linalg.solve(covariance, difference[..., None])[..., 0]).sum(1)


def ellipsoid_coverage(
    mean: Float[np.ndarray, "N D"],
    covariance: Float[np.ndarray, "N D D"],
    truth: Float[np.ndarray, "N D"],
    levels: Sequence[float] = LEVELS,
) -> tuple[float, ...]:
    """Share of rows whose truth lies within the ellipsoid that holds each probability of N(mean, covariance)."""
    squared = mahalanobis_squared(mean, covariance, truth)
    return tuple(float(np.mean(squared <= chi2.ppf(level, mean.shape[1]))) for level in levels)


def interval_coverage(
    samples: Float[np.ndarray, "N M D"], truth: Float[np.ndarray, "N D"], levels: Sequence[float] = LEVELS
) -> tuple[float, ...]:
    """Share of single numbers of the truth within the central interval of their samples."""
    tails = [tail for level in levels for tail in (0.5 - level / 2, 0.5 + level / 2)]
    edges = np.quantile(samples, tails, axis=1)
    return tuple(float(np.mean((edges[2 * i] <= truth) & (truth <= edges[2 * i + 1]))) for i in range(len(levels)))


def gaussian_samples(
    mean: Float[np.ndarray, "N D"], covariance: Float[np.ndarray, "N D D"], n_samples: int, rng: np.random.Generator
) -> Float[np.ndarray, "N M D"]:
    """`n_samples` of every row's Gaussian."""
    noise = rng.standard_normal((len(mean), n_samples, mean.shape[1]))
    return mean[:, None] + noise @ np.linalg.cholesky(covariance).swapaxes(1, 2)


def energy_score(samples: Float[np.ndarray, "N M D"], truth: Float[np.ndarray, "N D"]) -> Float[np.ndarray, " N"]:
    """E|X - y| - E|X - X'| / 2 of every row, estimated from its samples (Gneiting and Raftery 2007, Eq. 21).

    Unbiased: X' is the next sample. In one dimension it is the continuous ranked probability score.
    """
    distance = np.linalg.norm(samples - truth[:, None], axis=2).mean(1)
    spread = np.linalg.norm(samples - np.roll(samples, 1, axis=1), axis=2).mean(1)
    return distance - 0.5 * spread


def calibration(passes: Sequence[Pass], rng: np.random.Generator, n_samples: int = N_SAMPLES) -> Calibration | None:
    """Calibration over all complete windows of some trials; None where there is none."""
    latent, point, decoded, decoded_point, coverage, decoded_coverage, counts = [], [], [], [], [], [], []
    for one in passes:
        known = one.known
        if not known.any():
            continue
        mean, covariance, truth = one.partner_mean[known], one.partner_covariance[known], one.partner_truth[known]
        samples = gaussian_samples(mean, covariance, n_samples, rng)
        latent.append(energy_score(samples, truth))
        point.append(np.linalg.norm(mean - truth, axis=1))
        coverage.append(ellipsoid_coverage(mean, covariance, truth))
        frames = one.first_frame(one.partner_vae.decode(samples.reshape(-1, samples.shape[2])))
        outcomes = frames.reshape(*samples.shape[:2], -1)
        true_frames = one.first_frame(one.truth[known])
        decoded.append(energy_score(outcomes, true_frames))
        decoded_point.append(np.linalg.norm(one.first_frame(one.predicted[known]) - true_frames, axis=1))
        decoded_coverage.append(interval_coverage(outcomes, true_frames))
        counts.append(int(known.sum()))
    if not counts:
        return None
    return Calibration(
        n_windows=sum(counts),
        coverage=tuple(np.average(coverage, axis=0, weights=counts).tolist()),
        energy=float(np.concatenate(latent).mean()),
        energy_point=float(np.concatenate(point).mean()),
        decoded_coverage=tuple(np.average(decoded_coverage, axis=0, weights=counts).tolist()),
        decoded_energy=float(np.concatenate(decoded).mean()),
        decoded_point=float(np.concatenate(decoded_point).mean()),
    )
