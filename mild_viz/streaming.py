"""The same chain one observation at a time: step(model, carry, observation) -> (carry, command).

Fed with the frames of a trial it gives the numbers of `pipeline.infer` and `pipeline.control` row by row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.data.windows import max_gap
from mild_viz.latent.gmr import condition
from mild_viz.latent.hmm import HMM, forward_filter, log_emission
from mild_viz.latent.transition import TransitionState
from mild_viz.latent.vae import VAE
from mild_viz.pipeline import uses_transition, with_contact_states
from mild_viz.robot.contact import in_frame
from mild_viz.robot.controller import ControlCarry, initial_carry, run_controller
from mild_viz.robot.model import RobotModel
from mild_viz.settings import HUMAN_FEATURES, VARIANTS, WINDOW, ControlSettings


@dataclass(frozen=True, eq=False)
class StreamModel:
    """What does not change between observations."""

    human_vae: VAE
    robot_vae: VAE
    hmm: HMM
    human_hmm: HMM
    transition: TransitionState | None
    posterior_covariance: bool
    action: str
    robot: RobotModel
    settings: ControlSettings
    T_world_human: Float[np.ndarray, "4 4"]
    max_gap: int
    """Frames for which a lost observation is bridged."""


class Carry(NamedTuple):
    """What one observation leaves to the next."""

    features: Float[np.ndarray, "W F"]
    """The last window of features; NaN where not observed."""
    n_frames: int
    last_seen: Float[np.ndarray, "3 3"] | None
    """The last complete arm."""
    gap: int
    """Frames since it was seen."""
    previous: Float[np.ndarray, " 9"] | None
    """The previous frame's filled position."""
    log_alpha: Float[np.ndarray, " S"] | None
    control: ControlCarry


class Command(NamedTuple):
    """The answer to one observation; `None` fields until the first window is full."""

    log_alpha: Float[np.ndarray, " S"]
    log_transition: float
    active_state: int
    robot_latent_mean: Float[np.ndarray, " D"]
    robot_latent_covariance: Float[np.ndarray, "D D"]
    joints_decoded: Float[np.ndarray, " J"]
    joints_commanded: Float[np.ndarray, " J"]
    target: Float[np.ndarray, " 3"]
    contact: bool
    stiffness: Float[np.ndarray, " J"]


def stream_model(
    checkpoint: Checkpoint,
    variant: str,
    action: str,
    robot: RobotModel,
    settings: ControlSettings,
    T_world_human: Float[np.ndarray, "4 4"],
    rate: float,
) -> StreamModel:
    """Everything that a stream of observations at `rate` [Hz] needs."""
    hmm = checkpoint.hmm(action)
    return StreamModel(
        human_vae=checkpoint.human_vae,
        robot_vae=checkpoint.robot_vae(variant),
        hmm=hmm,
        human_hmm=hmm.marginal(slice(0, checkpoint.human_vae.latent_size)),
        transition=checkpoint.transition_states.get(action),
        posterior_covariance=VARIANTS[variant].posterior_covariance,
        action=action,
        robot=robot,
        settings=with_contact_states(settings, checkpoint, action),
        T_world_human=T_world_human,
        max_gap=max_gap(rate),
    )


def start(model: StreamModel) -> Carry:
    """The state before the first observation."""
    empty = np.full((WINDOW, HUMAN_FEATURES), np.nan)
    return Carry(empty, 0, None, 0, None, None, initial_carry(model.robot.chain))


def step(model: StreamModel, carry: Carry, arm: Float[np.ndarray, "3 3"]) -> tuple[Carry, Command | None]:
    """Take one observation of the human's arm (shoulder, elbow, wrist [m]; NaN where lost).

    Returns the new carry, and the command for the next frame: None until five observations were taken.
    """
    seen = _observe(model, carry, arm)
    if seen.n_frames < WINDOW:
        return seen, None
    window = seen.features.reshape(1, -1)
    if np.isnan(window).any():
        window = np.full_like(window, np.nan)
    mean, std = model.human_vae.encode(window)
    likelihood = log_emission(model.human_hmm, mean)
    log_alpha, _ = forward_filter(model.human_hmm, likelihood, seen.log_alpha)
    log_transition = np.full(1, -np.inf)
    if model.transition is not None:
        log_transition = model.transition.log_probability(mean, likelihood, log_alpha)
    latent_mean, latent_covariance = condition(model.hmm, mean, log_alpha, std if model.posterior_covariance else None)
    decoded = model.robot_vae.decode(latent_mean)[:, : len(model.robot.chain.joint_names)]
    hand = np.full(3, np.nan) if seen.previous is None else seen.previous[6:9]
    target = in_frame(model.T_world_human, hand[None])
    result = run_controller(
        model.robot.chain,
        model.settings,
        model.action,
        log_alpha,
        decoded,
        target,
        seen.control,
        log_transition if uses_transition(model.settings, model.transition) else None,
    )
    command = Command(
        log_alpha=log_alpha[0],
        log_transition=float(log_transition[0]),
        active_state=int(log_alpha[0].argmax()),
        robot_latent_mean=latent_mean[0],
        robot_latent_covariance=latent_covariance[0],
        joints_decoded=decoded[0],
        joints_commanded=result.joints[0],
        target=target[0],
        contact=bool(result.contact[0]),
        stiffness=result.stiffness[0],
    )
    return seen._replace(log_alpha=log_alpha[0], control=result.carry), command


def _observe(model: StreamModel, carry: Carry, arm: Float[np.ndarray, "3 3"]) -> Carry:
    """Fill a gap, take the velocity, shift the window: what data.windows does for a whole trial."""
    if np.isnan(arm).any():
        gap = carry.gap + 1
        filled = carry.last_seen if carry.last_seen is not None and gap <= model.max_gap else np.full((3, 3), np.nan)
        last_seen = carry.last_seen
    else:
        gap, filled, last_seen = 0, arm, arm
    position = filled.reshape(9)
    velocity = np.zeros(9) if carry.previous is None else position - carry.previous
    features = np.concatenate([carry.features[1:], np.concatenate([position, velocity])[None]])
    return Carry(features, carry.n_frames + 1, last_seen, gap, position, carry.log_alpha, carry.control)
