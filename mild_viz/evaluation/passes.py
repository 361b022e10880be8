"""One trial as a model sees it: what segmentation, calibration and distances are measured on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.checkpoint import Checkpoint
from mild_viz.evaluation.metrics import window_errors
from mild_viz.latent.gmr import condition
from mild_viz.latent.hmm import HMM, forward_filter, log_emission, observed_rows
from mild_viz.latent.vae import VAE
from mild_viz.pairs import stack_windows
from mild_viz.settings import VARIANTS, WINDOW
from mild_viz.trial import Trial


class Prediction(NamedTuple):
    """What a model says about N human windows."""

    human_mean: Float[np.ndarray, "N D"]
    log_alpha: Float[np.ndarray, "N S"]
    robot_mean: Float[np.ndarray, "N D"]
    robot_covariance: Float[np.ndarray, "N D D"]
    decoded: Float[np.ndarray, "N Y"]


@dataclass(frozen=True, eq=False)
class Pass:
    """A trial of N windows under one variant. Row n belongs to human window n, newest observation in frame n + 4.

    The partner is the robot, or the second human where the model drives no robot.
    """

    trial: Trial
    human_human: bool
    hmm: HMM
    partner_vae: VAE
    log_alpha: Float[np.ndarray, "N S"]
    """Given the human alone: what runs on a robot."""
    log_alpha_joint: Float[np.ndarray, "N S"]
    """Given both partners."""
    human_mean: Float[np.ndarray, "N D"]
    partner_mean: Float[np.ndarray, "N D"]
    partner_covariance: Float[np.ndarray, "N D D"]
    partner_truth: Float[np.ndarray, "N D"]
    """The recorded partner's window, encoded; NaN where it is unknown."""
    predicted: Float[np.ndarray, "N Y"]
    truth: Float[np.ndarray, "N Y"]
    """The partner's windows (frames n + 5 to n + 9), predicted and recorded; NaN where unknown."""
    errors: Float[np.ndarray, " N"]
    """`metrics.window_errors` of each; NaN where a window is incomplete."""

    @property
    def active(self) -> Int[np.ndarray, " N"]:
        """The active state: argmax of the human-only forward variable."""
        return self.log_alpha.argmax(1)

    @property
    def active_joint(self) -> Int[np.ndarray, " N"]:
        return self.log_alpha_joint.argmax(1)

    @property
    def known(self) -> Bool[np.ndarray, " N"]:
        """Rows whose human and partner windows are complete."""
        return np.isfinite(self.errors)

    @property
    def newest(self) -> slice:
        """Frames of the newest observations."""
        return slice(WINDOW - 1, WINDOW - 1 + len(self.errors))

    @property
    def phase(self) -> Int[np.ndarray, " N"] | None:
        """True phase at the newest observation (index into `trial.PHASES`), where it is known."""
        return None if self.trial.phase is None else self.trial.phase[self.newest]

    def first_frame(self, windows: Float[np.ndarray, "N Y"]) -> Float[np.ndarray, "N F"]:
        """Of partner windows, the joints [rad] or arm positions [m] of the first frame."""
        features = windows.shape[1] // WINDOW
        return windows[:, : features // 2 if self.human_human else features]


def variants_of(checkpoint: Checkpoint) -> tuple[str, ...]:
    """The variants that a checkpoint can be measured in; the human-human model is v1."""
    return checkpoint.variants or ("v1",)


def run_passes(checkpoint: Checkpoint, variant: str, trials: Sequence[Trial]) -> list[Pass]:
    """Every trial under one variant. Raises `UserError` where a trial does not fit the model."""
    human_human = checkpoint.robot is None
    data = stack_windows(trials, checkpoint.robot.joint_names if checkpoint.robot else None)
    decoder = checkpoint.human_vae if human_human else checkpoint.robot_vae(variant)
    passes = []
    for index, trial in enumerate(trials):
        human, partner = data.human[data.rows(index)], data.partner[data.rows(index)]
        hmm = checkpoint.hmm(trial.action)
        said = _predict(checkpoint, variant, trial.action, human)
        truth, _ = decoder.encode(partner)
        errors = window_errors(said.decoded, partner, human_human)
        passes.append(
            Pass(
                trial=trial,
                human_human=human_human,
                hmm=hmm,
                partner_vae=decoder,
                log_alpha=said.log_alpha,
                log_alpha_joint=_joint_alpha(hmm, said.human_mean, truth),
                human_mean=said.human_mean,
                partner_mean=said.robot_mean,
                partner_covariance=said.robot_covariance,
                partner_truth=truth,
                predicted=said.decoded,
                truth=partner,
                errors=np.where(data.complete[data.rows(index)], errors, np.nan),
            )
        )
    return passes


def _predict(checkpoint: Checkpoint, variant: str, action: str, human: Float[np.ndarray, "N X"]) -> Prediction:
    hmm = checkpoint.hmm(action)
    decoder = checkpoint.human_vae if checkpoint.robot is None else checkpoint.robot_vae(variant)
    mean, std = checkpoint.human_vae.encode(human)
    human_hmm = hmm.marginal(slice(0, mean.shape[1]))
    log_alpha, _ = forward_filter(human_hmm, log_emission(human_hmm, mean))
    posterior = std if VARIANTS[variant].posterior_covariance else None
    robot_mean, robot_covariance = condition(hmm, mean, log_alpha, posterior)
    return Prediction(mean, log_alpha, robot_mean, robot_covariance, decoder.decode(robot_mean))


def _joint_alpha(
    hmm: HMM, human_mean: Float[np.ndarray, "N D"], partner_truth: Float[np.ndarray, "N D"]
) -> Float[np.ndarray, "N S"]:
    """The forward variable given both partners; where the partner was lost, the human alone still says something."""
    human_hmm = hmm.marginal(slice(0, human_mean.shape[1]))
    both = np.concatenate([human_mean, partner_truth], axis=1)
    seen = observed_rows(both)[:, None]
    return forward_filter(hmm, np.where(seen, log_emission(hmm, both), log_emission(human_hmm, human_mean)))[0]
