"""The Gaussian hidden Markov model over joint human and robot latents: filter, smoother, Viterbi path."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.errors import UserError
from mild_viz.latent import kernels
from mild_viz.trial import freeze_arrays


def safe_log(probabilities: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Logarithm that maps 0 to -inf without a warning."""
    with np.errstate(divide="ignore"):
        return np.log(probabilities)


FilterCarry = Float[np.ndarray, "S *elapsed"]
"""What a filter leaves to the next step: log probabilities of the states, in a model with durations by elapsed time."""


@dataclass(frozen=True, eq=False)
class HMM:
    """A hidden Markov model with full-covariance Gaussian emissions (Sec. III-B of the paper).

    `transition_matrix[i, j]` is p(j given i). In a joint model the first `human_size` latent dimensions are
    the human's, the others the robot's (Eq. gmr).
    """

    initial_probs: Float[np.ndarray, " S"]
    transition_matrix: Float[np.ndarray, "S S"]
    emission_means: Float[np.ndarray, "S D"]
    emission_covariances: Float[np.ndarray, "S D D"]

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @property
    def n_states(self) -> int:
        return len(self.initial_probs)

    @cached_property
    def log_transition(self) -> Float[np.ndarray, "S S"]:
        return safe_log(self.transition_matrix)

    @cached_property
    def whitening(self) -> tuple[Float[np.ndarray, "S D D"], Float[np.ndarray, "S D"], Float[np.ndarray, " S"]]:
        """Per state W, b, c such that log N(z; mu, Sigma) = c - |W z - b|^2 / 2."""
        factors = np.linalg.cholesky(self.emission_covariances)
        inverse = np.linalg.inv(factors)
        log_det = np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(1)
        offsets = (inverse @ self.emission_means[..., None])[..., 0]
        return inverse, offsets, -log_det - 0.5 * self.emission_means.shape[1] * np.log(2 * np.pi)

    def marginal(self, dimensions: slice) -> HMM:
        """The model of some of the latent dimensions alone."""
        return replace(
            self,
            emission_means=self.emission_means[:, dimensions],
            emission_covariances=self.emission_covariances[:, dimensions, dimensions],
        )

    def filter(
        self, log_likelihood: Float[np.ndarray, "N S"], carry: FilterCarry | None = None
    ) -> tuple[Float[np.ndarray, "N S"], float, FilterCarry]:
        """Normalised forward variable log alpha (Eq. hmm-h), log p(z_{1:N}), and what the next call goes on from.

        `carry` is what an earlier call returned: the recursion goes on after its last step.
        """
        if carry is None:
            log_prior = safe_log(self.initial_probs)
        else:
            log_prior = np.logaddexp.reduce(carry[:, None] + self.log_transition, axis=0)
        log_alpha = np.empty(log_likelihood.shape)
        total = kernels.forward(log_prior, self.log_transition, np.ascontiguousarray(log_likelihood), log_alpha)
        return log_alpha, float(total), log_alpha[-1]

    def smooth(self, log_likelihood: Float[np.ndarray, "N S"]) -> Float[np.ndarray, "N S"]:
        """log p(state at n given z_{1:N}), by forward-backward."""
        log_alpha, _, _ = self.filter(log_likelihood)
        log_beta = np.empty_like(log_alpha)
        kernels.backward(self.log_transition, np.ascontiguousarray(log_likelihood), log_beta)
        log_gamma = log_alpha + log_beta
        return log_gamma - np.logaddexp.reduce(log_gamma, axis=1, keepdims=True)

    def viterbi(self, log_likelihood: Float[np.ndarray, "N S"]) -> tuple[Int[np.ndarray, " N"], float]:
        """Most likely state sequence, and its joint log probability with the observations."""
        path = np.empty(len(log_likelihood), dtype=np.int64)
        log_prior = safe_log(self.initial_probs)
        score = kernels.viterbi(log_prior, self.log_transition, np.ascontiguousarray(log_likelihood), path)
        return path, float(score)


def check_hmm(hmm: HMM, where: str) -> HMM:
    """Return `hmm` if it is a valid model, else raise an error that says what is wrong."""
    for field in fields(hmm):
        if not np.isfinite(getattr(hmm, field.name)).all():
            raise UserError(f"{where}: {field.name} has values that are not finite")
    if (hmm.transition_matrix < 0).any() or not np.allclose(hmm.transition_matrix.sum(1), 1.0, atol=1e-6):
        raise UserError(
            f"{where}: rows of transition_matrix are not probabilities (sums {hmm.transition_matrix.sum(1)})"
        )
    if (hmm.initial_probs < 0).any() or not np.isclose(hmm.initial_probs.sum(), 1.0, atol=1e-6):
        raise UserError(f"{where}: initial_probs are not probabilities (sum {hmm.initial_probs.sum()})")
    covariances = hmm.emission_covariances
    largest = np.abs(covariances).max((1, 2), keepdims=True)
    if (np.abs(covariances / largest.clip(1e-300) - covariances.swapaxes(1, 2) / largest.clip(1e-300)) > 1e-6).any():
        raise UserError(f"{where}: emission_covariances are not symmetric")
    try:
        lowest = np.linalg.eigvalsh(covariances).min()
        np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError as error:
        lowest = f"unknown, {error}"
    if isinstance(lowest, str) or not lowest > 0:
        raise UserError(f"{where}: emission_covariances are not positive definite (lowest eigenvalue {lowest})")
    return hmm


def observed_rows(z: Float[np.ndarray, "N D"]) -> Bool[np.ndarray, " N"]:
    """True where a step has an observation."""
    return np.logical_and.reduce(np.isfinite(z), axis=1)


def log_emission(hmm: HMM, z: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N S"]:
    """log N(z_n; mu_i, Sigma_i). A row of `z` with NaN is a missing observation and gives a row of zeros."""
    log_density = np.empty((len(z), hmm.n_states))
    kernels.log_density(np.ascontiguousarray(z), *hmm.whitening, log_density)
    return log_density


def forward_filter(hmm: HMM, log_likelihood: Float[np.ndarray, "N S"]) -> tuple[Float[np.ndarray, "N S"], float]:
    """Normalised forward variable log alpha (Eq. hmm-h), and log p(z_{1:N}), of a whole sequence.

    A row of zeros in `log_likelihood` is a step without an observation; all rows zero give the unobserved
    forward variable of Eq. vaeHMM-prior.
    """
    log_alpha, total, _ = hmm.filter(log_likelihood)
    return log_alpha, total


def unobserved_forward(hmm: HMM, n_steps: int) -> Float[np.ndarray, "N S"]:
    """log of the unobserved forward variable (Eq. vaeHMM-prior) for the first `n_steps` steps."""
    return forward_filter(hmm, np.zeros((n_steps, hmm.n_states)))[0]
