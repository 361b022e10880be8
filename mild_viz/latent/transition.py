"""The transition state: what the human does where reaching turns into contact and the human-only filter lags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from mild_viz.errors import UserError
from mild_viz.latent.hmm import HMM, check_hmm, log_emission, observed_rows
from mild_viz.trial import freeze_arrays


@dataclass(frozen=True, eq=False)
class TransitionState:
    """A Gaussian over human latents in steps that the human-only filter still takes for reaching.

    Sec. Inverse Kinematics Adaptation and Stiffness Modulation of the paper: "an additional distribution over
    the states that get misclassified at the transition boundary between the reaching and contact phase".
    """

    mean: Float[np.ndarray, " D"]
    covariance: Float[np.ndarray, "D D"]
    hazard: float
    """Probability that a step of reaching is the one that enters the transition state."""
    contact_states: frozenset[int]
    """The HMM's contact states that this boundary leads to: beside others it means nothing."""

    def __post_init__(self) -> None:
        freeze_arrays(self)

    @cached_property
    def _emission(self) -> HMM:
        """A model whose one state emits this Gaussian."""
        return HMM(np.ones(1), np.ones((1, 1)), self.mean[None], self.covariance[None])

    def log_probability(
        self, z: Float[np.ndarray, "N D"], log_likelihood: Float[np.ndarray, "N S"], log_alpha: Float[np.ndarray, "N S"]
    ) -> Float[np.ndarray, " N"]:
        """log P(tau_n), the probability that step n has just entered the transition state.

        Beside the HMM's own explanation of the newest human latent z_n, which predicts it with density
        p(z_n | z_{1:n-1}), stands that reaching ends here, with prior h, the hazard:

            P(tau_n) = h N(z_n; mu, Sigma) / (h N(z_n; mu, Sigma) + (1 - h) p(z_n | z_{1:n-1}))

        and (1 - P(tau_n)) alpha_n(i) is left for state i. The density comes from the filter's own result, whatever
        filter it is: alpha_n(i) = p(i | z_{1:n-1}) N(z_n; i) / p(z_n | z_{1:n-1}), summed over all states, gives
        1 / p(z_n | z_{1:n-1}) = sum_i alpha_n(i) / N(z_n; i). `log_likelihood` holds log N(z_n; i), `log_alpha`
        the human-only forward variable. -inf where z_n is NaN: without an observation nothing is detected.

        Every step is judged alone: consecutive windows share four of five observations, so that adding their evidence
        up would count it several times, and contact would be detected far too early.
        """
        evidence = -np.logaddexp.reduce(log_alpha - log_likelihood, axis=1)
        log_odds = np.log(self.hazard) - np.log1p(-self.hazard) + log_emission(self._emission, z)[:, 0] - evidence
        return np.where(observed_rows(z), -np.logaddexp(0.0, -log_odds), -np.inf)


def check_transition_state(state: TransitionState, where: str) -> TransitionState:
    """Return `state` if it is valid, else raise an error that says what is wrong."""
    if not 0.0 < state.hazard < 1.0:
        raise UserError(f"{where}: hazard is {state.hazard}; valid: a number between 0 and 1, both excluded")
    if not state.contact_states:
        raise UserError(f"{where}: no contact states; expected one or more of the model's states")
    check_hmm(state._emission, where)
    return state


def fit_transition_state(
    human_hmm: HMM,
    contact_states: frozenset[int],
    latents: Sequence[Float[np.ndarray, "_ D"]],
    log_alpha_human: Sequence[Float[np.ndarray, "_ S"]],
    log_alpha_joint: Sequence[Float[np.ndarray, "_ S"]],
) -> TransitionState | None:
    """The transition state of one action, from the forward variables of its training trials.

    A trial's boundary is the first step in which a contact state is the most likely one given both partners. Steps
    from there on count as misclassified as long as the human alone was never taken for being in contact, and both
    together still are. Where the human alone is in contact before the boundary, nothing is late, and a
    distribution over those steps would only make it earlier: they do not count.

    Such steps are few. The covariance is therefore drawn towards that of the states on both sides of the boundaries,
    as if D + 2 more steps had shown it. The hazard is the number of boundaries at which the human alone lags, over the
    steps at risk: those before the first contact by either filter, and the boundaries themselves.

    Returns None where no step is misclassified: then the human-only filter needs no help.
    """
    late, sides, at_risk = [], [], 1  # one step more, so that it is never certain
    for z, human, joint in zip(latents, log_alpha_human, log_alpha_joint, strict=True):
        active = joint.argmax(1)
        touching, human_touching = (np.isin(states, sorted(contact_states)) for states in (active, human.argmax(1)))
        boundary, entry = _first(touching), _first(human_touching)
        if not 0 < boundary < len(z):
            continue  # no reaching, or no contact
        at_risk += min(boundary + 1, entry)
        end = min(entry, boundary + _first(~touching[boundary:]))
        steps = z[boundary:end]
        steps = steps[observed_rows(steps)]
        if len(steps):
            late.append(steps)
            sides.append(human_hmm.emission_covariances[active[[boundary - 1, boundary]]])
    if not late:
        return None
    stacked = np.concatenate(late)
    n_steps, size = stacked.shape
    prior = np.concatenate(sides).mean(0)
    centred = stacked - stacked.mean(0)
    covariance = (centred.T @ centred + (size + 2) * prior) / (n_steps + size + 2)
    return TransitionState(stacked.mean(0), covariance, len(late) / at_risk, contact_states)


def _first(flags: Bool[np.ndarray, " N"]) -> int:
    """Index of the first True; the length where there is none."""
    return int(flags.argmax()) if flags.any() else len(flags)
