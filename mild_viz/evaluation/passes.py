"""One trial as a model sees it: what segmentation, calibration and distances are measured on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mild_viz.checkpoint import Checkpoint
from mild_viz.evaluation.metrics import joint_names, window_errors
from mild_viz.latent.hmm import HMM
from mild_viz.latent.vae import VAE
from mild_viz.pairs import stack_windows
from mild_viz.pipeline import joint_log_alpha
from mild_viz.prediction import predict
from mild_viz.settings import WINDOW
from mild_viz.trial import Trial


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


def run_passes(checkpoint: Checkpoint, variant: str, trials: Sequence[Trial]) -> list[Pass]:
    """Every trial under one variant; states and latents are those of its first model, predictions the average of all.

    Raises:
        UserError: where a trial does not fit the model.
    """
    if not trials:
        return []
    human_human = checkpoint.robot is None
    data = stack_windows(trials, joint_names(checkpoint))
    model = checkpoint.members(variant)[0]
    passes = []
    for index, trial in enumerate(trials):
        rows = data.rows(index)
        said = predict(checkpoint, variant, trial.action, data.human[rows])
        partner = data.partner[rows]
        truth, _ = model.robot_vae.encode(partner)
        passes.append(
            Pass(
                trial=trial,
                human_human=human_human,
                hmm=model.hmms[trial.action],
                partner_vae=model.robot_vae,
                log_alpha=said.log_alpha,
                log_alpha_joint=joint_log_alpha(model, trial.action, said.human_mean, truth),
                human_mean=said.human_mean,
                partner_mean=said.robot_mean,
                partner_covariance=said.robot_covariance,
                partner_truth=truth,
                predicted=said.decoded,
                truth=partner,
                errors=np.where(data.complete[rows], window_errors(said.decoded, partner, human_human), np.nan),
            )
        )
    return passes
