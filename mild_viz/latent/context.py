"""Conditioning on a short history: what `v4` puts in the place of the newest human latent alone.

The context of a step is c_t = [z_t, z_{t - lag_1}, ..., f(t)]: the human's latent now and some frames ago, and the time
since the trial began. Per state, c_t and the robot's latent are jointly Gaussian, so that the conditional is that of
Eq. gmr-conditioning-mu-i with the context in the place of the human's latent, and with a noise covariance on the
context in the place of the posterior's covariance (Eq. conditioning-withcov-K-i).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mild_viz.errors import UserError
from mild_viz.latent.gmr import mix_states
from mild_viz.latent.hmm import observed_rows
from mild_viz.trial import freeze_arrays

CLOCK_STEP = 1.0
"""Distance and width of the bumps that tell the time [s]: as exact as people are on time."""

CLOCK_SPAN = 15.0
"""Time after which the clock stands still [s]: few trials are longer."""

MAX_LAG = 1000
"""Longest lag [frames]."""

MAX_CLOCK = 100.0
"""Largest height of the clock's bumps."""

RESIDUAL_FLOOR = 1e-4
"""Added to the diagonal of every conditional covariance [latent units squared]."""


def _bumps() -> Float[np.ndarray, " K"]:
    return np.arange(int(CLOCK_SPAN / CLOCK_STEP) + 1.0)


@dataclass(frozen=True)
class ContextLayout:
    """What stands in a context vector besides the newest human latent."""

    lags: tuple[int, ...] = ()
    """How many frames ago the further latents are taken."""
    clock: float = 0.0
    """Height of the bumps that tell the time since the trial began; 0: it is not in the context."""

    def __post_init__(self) -> None:
        if any(type(lag) is not int or not 1 <= lag <= MAX_LAG for lag in self.lags):
            raise UserError(f"lags are {self.lags}; valid: whole numbers of frames from 1 to {MAX_LAG}")
        if not 0.0 <= self.clock <= MAX_CLOCK:
            raise UserError(f"clock is {self.clock}; valid: a number from 0 to {MAX_CLOCK:g}")

    @property
    def n_history(self) -> int:
        """How many past latents a stream has to remember."""
        return max(self.lags, default=0)

    def size(self, latent_size: int) -> int:
        """Length C of a context vector."""
        return latent_size * (1 + len(self.lags)) + (len(_bumps()) if self.clock else 0)

    def times(self, steps: Float[np.ndarray, " N"], rate: float) -> Float[np.ndarray, "N K"]:
        """Bumps exp(-(t/step - k)^2 / 2) over the time since the beginning, K of them; K = 0 without a clock.

        With the noise on the context they smooth over time, as much as their height says.
        """
        if not self.clock:
            return np.empty((len(steps), 0))
        time = np.minimum(steps / rate, CLOCK_SPAN)
        return self.clock * np.exp(-0.5 * (time[:, None] / CLOCK_STEP - _bumps()) ** 2)

    def contexts(
        self, z: Float[np.ndarray, "N D"], history: Float[np.ndarray, "L D"], first_step: int, rate: float
    ) -> Float[np.ndarray, "N C"]:
        """Context of N steps. `z` has its gaps filled; `history` are the L latents before it, the newest last.

        Before the first step of a trial, its first latent stands in; where a trial begins untracked, the present one.
        """
        n = len(z)
        before = np.concatenate([history, z])
        steps = first_step + np.arange(n)
        parts = [z]
        for lag in self.lags:
            past = before[len(history) + np.arange(n) - np.minimum(lag, steps)]
            parts.append(np.where(np.isnan(past), z, past))
        return np.concatenate([*parts, self.times(steps.astype(float), rate)], axis=1)


@dataclass(frozen=True, eq=False)
class ContextRegression:
    """The Gaussian of every state, of the robot's latent given the context.

    The conditional mean of state i is offset_i + K_i c, its covariance does not depend on c.
    """

    gain: Float[np.ndarray, "S R C"]
    offset: Float[np.ndarray, "S R"]
    covariance: Float[np.ndarray, "S R R"]

    def __post_init__(self) -> None:
        freeze_arrays(self)


def fit_regression(
    contexts: Float[np.ndarray, "N C"],
    robot: Float[np.ndarray, "N R"],
    weights: Float[np.ndarray, "N S"],
    noise: float,
) -> ContextRegression:
    """Weighted Gaussians of context and robot latent, one a state, and their conditionals.

    `weights` is the human-only forward variable: the states are weighed as they will be when the model runs. `noise`
    is the variance of the noise on every number of the context [latent units squared], Sigma_z of
    Eq. conditioning-withcov-K-i: K_i = Sigma^rc_i (Sigma^cc_i + noise I)^-1. It keeps a long context from fitting the
    few trials by heart.
    """
    n_states, size = weights.shape[1], contexts.shape[1]
    gain = np.empty((n_states, robot.shape[1], size))
    offset = np.empty((n_states, robot.shape[1]))
    covariance = np.empty((n_states, robot.shape[1], robot.shape[1]))
    overall_c, overall_r = contexts.mean(0), robot.mean(0)
    for state in range(n_states):
        w = weights[:, state, None]
        mass = float(w.sum()) + 1.0  # one further step at the overall means keeps a state that is never visited finite
        mean_c = ((w * contexts).sum(0) + overall_c) / mass
        mean_r = ((w * robot).sum(0) + overall_r) / mass
        c, r = contexts - mean_c, robot - mean_r
        weighted = (w * c).T
        gain[state] = np.linalg.solve(weighted @ c / mass + noise * np.eye(size), weighted @ r / mass).T
        offset[state] = mean_r - gain[state] @ mean_c
        residual = r - c @ gain[state].T
        covariance[state] = (w * residual).T @ residual / mass + RESIDUAL_FLOOR * np.eye(robot.shape[1])
    return ContextRegression(gain, offset, covariance)


def condition_on_context(
    regression: ContextRegression,
    contexts: Float[np.ndarray, "N C"],
    log_alpha: Float[np.ndarray, "N S"],
    robot_means: Float[np.ndarray, "S R"],
    robot_covariances: Float[np.ndarray, "S R R"],
) -> tuple[Float[np.ndarray, "N R"], Float[np.ndarray, "N R R"]]:
    """Mean and covariance of p(z_r given the context), for every step.

    A step whose context is NaN has no observation: the states' own Gaussians, `robot_means` and
    `robot_covariances`, remain, as in `gmr.condition`.
    """
    n_states, n_robot, size = regression.gain.shape
    seen = observed_rows(contexts)
    means = (contexts @ regression.gain.reshape(-1, size).T).reshape(-1, n_states, n_robot) + regression.offset
    covariances = np.broadcast_to(regression.covariance, (len(contexts), *regression.covariance.shape))
    if not seen.all():
        means[~seen] = robot_means
        covariances = np.where(seen[:, None, None, None], covariances, robot_covariances)
    return mix_states(np.exp(log_alpha), means, covariances)
