"""A rollout in which nothing has happened yet: what the scene lays itself out by before the first interaction."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.pipeline import state_gaussians
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import ControlSettings, Placement
from mild_viz.trial import Skeleton

SPREAD = 2.0
"""The latent plot shows the states out to so many standard deviations."""


def resting_rollout(
    checkpoint: Checkpoint,
    variant: str,
    action: str,
    robot: RobotModel,
    settings: ControlSettings,
    T_world_human: Float[np.ndarray, "4 4"],
    arm: Float[np.ndarray, "3 3"],
    skeleton: Skeleton | None,
) -> Rollout:
    """The robot at rest before a person in this posture. The latents are points all around the HMM's states, so that
    the plot's axes hold whatever will come."""
    model = checkpoint.members(variant)[0]
    hmm, size = model.hmms[action], model.human_vae.latent_size
    states = state_gaussians(hmm, size)
    around = [
        sigma_points(states[f"{who}_state_means"], states[f"{who}_state_covariances"]) for who in ("human", "robot")
    ]
    n_rows, n_joints = len(around[0]), robot.chain.n_joints
    joints = np.tile(robot.chain.rest, (n_rows, 1))
    joints[-1] += 0.05  # so that the views find which links move
    log_alpha = np.tile(np.log(np.full(hmm.n_states, 1.0 / hmm.n_states)), (n_rows, 1))
    arms = np.tile(arm, (n_rows, 1, 1))
    unknown, flat = np.full((n_rows, n_joints), np.nan), np.zeros((n_rows, size, size))
    if skeleton is not None:
        skeleton = Skeleton(skeleton.joint_names, skeleton.bones, np.repeat(skeleton.positions[-1:], n_rows, axis=0))
    inference = Inference(
        dataset="live",
        split="test",
        trial=0,
        action=action,
        variant=variant,
        rate=checkpoint.rate or 30.0,
        joint_names=robot.chain.joint_names,
        time=np.arange(n_rows, dtype=float),
        observed=np.zeros(n_rows, dtype=bool),
        tracked=np.zeros(n_rows, dtype=bool),
        log_alpha_human=log_alpha,
        log_alpha_joint=log_alpha,
        log_alpha_unobserved=log_alpha,
        active_state=np.arange(n_rows) % hmm.n_states,
        log_transition=np.full(n_rows, -np.inf),
        human_latent_mean=around[0],
        human_latent_covariance=flat,
        robot_latent_mean=around[1],
        robot_latent_covariance=flat,
        robot_latent_truth=np.full((n_rows, size), np.nan),
        joints_decoded=joints,
        joints_truth=unknown,
        window_error=np.full(n_rows, np.nan),
        **states,
        human_arm=arms,
        human_hand=arms[:, 2],
        human_skeleton=skeleton,
    )
    end_effector = robot.end_effector(joints)
    target = arms[:, 2] @ T_world_human[:3, :3].T + T_world_human[:3, 3]
    return Rollout(
        inference=inference,
        controller=settings.controller,
        robot=robot.name,
        joints_commanded=joints,
        end_effector=end_effector,
        end_effector_decoded=end_effector,
        target=target,
        hand_distance=np.linalg.norm(end_effector - target, axis=1),
        contact=np.zeros(n_rows, dtype=bool),
        stiffness=np.ones((n_rows, n_joints)),
        compliant=checkpoint.contact_rules_of(action).compliant,
        fired=np.zeros(n_rows, dtype=np.int64),
        T_world_human=T_world_human,
        link_names=robot.link_names,
        link_poses=robot.link_poses(joints, action),
        link_poses_decoded=robot.link_poses(joints, action),
        state_durations=np.zeros(hmm.n_states),
        state_occupancy=np.zeros(hmm.n_states),
        contact_states=settings.contact_states or frozenset(),
        placement=Placement(*(float(v) for v in T_world_human[:3, 3] - robot.chain.shoulder), source="live"),
    )


def sigma_points(means: Float[np.ndarray, "S D"], covariances: Float[np.ndarray, "S D D"]) -> Float[np.ndarray, "N D"]:
    """For each Gaussian its mean, and `SPREAD` deviations along each of its axes."""
    values, vectors = np.linalg.eigh(covariances)
    steps = SPREAD * np.sqrt(np.maximum(values, 0.0))[:, None] * vectors  # columns are axes
    ways = np.swapaxes(steps, 1, 2)
    return np.concatenate([means, *(means + sign * ways[:, i] for i in range(means.shape[1]) for sign in (1.0, -1.0))])
