"""One trained model: encode -> filter -> condition -> decode, over a whole trial or one observation at a time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.latent.context import ContextLayout, ContextRegression, condition_on_context
from mild_viz.latent.gmr import condition
from mild_viz.latent.hmm import HMM, FilterCarry, log_emission, observed_rows
from mild_viz.latent.transition import TransitionState
from mild_viz.latent.vae import VAE


class Prediction(NamedTuple):
    """What a model says about N windows of a human."""

    human_mean: Float[np.ndarray, "N D"]
    """Mean of the posterior q(z_h | x_h)."""
    human_std: Float[np.ndarray, "N D"]
    log_alpha: Float[np.ndarray, "N S"]
    """Human-only forward variable (Eq. hmm-h)."""
    log_transition: Float[np.ndarray, " N"]
    """log probability of the transition state; -inf without one, and where not observed."""
    robot_mean: Float[np.ndarray, "N D"]
    """Conditional mean of the robot's latent (Eq. conditioning-withcov-mu-t)."""
    robot_covariance: Float[np.ndarray, "N D D"]
    decoded: Float[np.ndarray, "N Y"]
    """The partner's windows."""


class ModelCarry(NamedTuple):
    """What one window leaves to the next."""

    filter: FilterCarry | None
    history: Float[np.ndarray, "L D"]
    """The last human latents, gaps filled with the one before; as many as the longest lag, fewer at the beginning."""
    step: int
    """Windows so far."""


@dataclass(frozen=True, eq=False)
class InteractionModel:
    """A human VAE, one HMM per action over both agents' latents, and the partner's VAE.

    With `regressions`, the partner's latent is conditioned on a context (`v4`), else on the newest human latent.
    """

    human_vae: VAE
    hmms: Mapping[str, HMM]
    robot_vae: VAE
    """The partner's: a second human's in a human-human model."""
    layout: ContextLayout = field(default_factory=ContextLayout)
    regressions: Mapping[str, ContextRegression] = field(default_factory=dict)
    transition_states: Mapping[str, TransitionState] = field(default_factory=dict)
    """By action; one without it is controlled by the HMM's states alone."""

    @cached_property
    def human_hmms(self) -> dict[str, HMM]:
        """The models of the human's latents alone, by action: what runs on a robot."""
        size = self.human_vae.latent_size
        return {action: hmm.marginal(slice(0, size)) for action, hmm in self.hmms.items()}

    def start(self) -> ModelCarry:
        """The carry before the first window of a trial."""
        return ModelCarry(None, np.empty((0, self.human_vae.latent_size)), 0)

    def advance(
        self,
        action: str,
        human: Float[np.ndarray, "N X"],
        carry: ModelCarry,
        rate: float,
        posterior_covariance: bool = False,
    ) -> tuple[Prediction, ModelCarry]:
        """Take N further windows of a trial at `rate` [Hz]; a window that is NaN is a missing observation.

        All at once or one by one gives the same numbers.
        """
        hmm, human_hmm = self.hmms[action], self.human_hmms[action]
        mean, std = self.human_vae.encode(human)
        likelihood = log_emission(human_hmm, mean)
        log_alpha, _, filtered = human_hmm.filter(likelihood, carry.filter)
        log_transition = np.full(len(mean), -np.inf)
        if action in self.transition_states:
            log_transition = self.transition_states[action].log_probability(mean, likelihood, log_alpha)
        history = carry.history
        if action in self.regressions:
            filled = _fill_forward(mean, history)
            contexts = self.layout.contexts(filled, history, carry.step, rate)
            contexts[~observed_rows(mean)] = np.nan
            size = mean.shape[1]
            robot_mean, robot_covariance = condition_on_context(
                self.regressions[action],
                contexts,
                log_alpha,
                hmm.emission_means[:, size:],
                hmm.emission_covariances[:, size:, size:],
            )
            kept = max(self.layout.n_history, 1)  # one at least: a gap is filled from it
            history = np.concatenate([history, filled])[-kept:]
        else:
            robot_mean, robot_covariance = condition(hmm, mean, log_alpha, std if posterior_covariance else None)
        decoded = self.robot_vae.decode(robot_mean)
        following = ModelCarry(filtered, history, carry.step + len(human))
        return Prediction(mean, std, log_alpha, log_transition, robot_mean, robot_covariance, decoded), following


def _fill_forward(z: Float[np.ndarray, "N D"], history: Float[np.ndarray, "L D"]) -> Float[np.ndarray, "N D"]:
    """Latents with each gap filled by the last one seen; NaN before the first."""
    known = np.concatenate([history[-1:], z])
    seen = observed_rows(known)
    last = np.maximum.accumulate(np.where(seen, np.arange(len(known)), -1))
    return known[np.maximum(last, 0)][len(history[-1:]) :]
