"""An invented rollout of real recorded people (the demo set) and the real Pepper, without a trained model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mild_viz.data.demo import make_demo
from mild_viz.robot.model import RobotModel
from mild_viz.robot.retarget import retarget_pepper
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import Placement
from mild_viz.trial import Skeleton

N_STATES = 4


def scene_inference(
    action: str = "handshake", whole: bool = True, n_states: int = N_STATES, **fields: Any
) -> Inference:
    """A demo trial with states that follow one another, and latent trajectories on smooth curves."""
    trial = next(trial for trial in make_demo().test if trial.action == action)
    rng = np.random.default_rng(3)
    n = trial.n_frames - 9
    partner = trial.partner_arm
    skeleton = trial.human_skeleton
    assert partner is not None and skeleton is not None
    steps = np.linspace(0.0, n_states, n, endpoint=False)
    scores = -8.0 * (steps[:, None] - np.arange(n_states) - 0.5) ** 2
    log_alpha = scores - np.log(np.exp(scores).sum(1, keepdims=True))
    curve = np.stack([np.sin(k * steps / n_states + k) for k in range(1, 6)], axis=1)
    means = rng.normal(size=(2, n_states, 5))
    factors = 0.3 * rng.normal(size=(2, n_states, 5, 5))
    covariances = factors @ np.swapaxes(factors, -1, -2) + 1e-3 * np.eye(5)
    joints = np.nan_to_num(retarget_pepper(np.nan_to_num(partner)))[5 : 5 + n]
    arm = trial.human_arm[4 : 4 + n]
    values: dict[str, Any] = {
        "dataset": "demo",
        "split": "test",
        "trial": trial.index,
        "action": action,
        "variant": "v3.1",
        "rate": trial.rate,
        "joint_names": ("RShoulderPitch", "RShoulderRoll", "RElbowYaw", "RElbowRoll"),
        "time": (np.arange(n) + 4) / trial.rate,
        "observed": np.isfinite(arm).all((1, 2)),
        "tracked": np.isfinite(arm).all((1, 2)),
        "log_alpha_human": log_alpha,
        "log_alpha_joint": log_alpha,
        "log_alpha_unobserved": np.full((n, n_states), -np.log(n_states)),
        "active_state": log_alpha.argmax(1),
        "log_transition": np.full(n, -np.inf),
        "human_latent_mean": curve,
        "human_latent_covariance": np.tile(0.01 * np.eye(5), (n, 1, 1)),
        "robot_latent_mean": 0.8 * curve + 0.3,
        "robot_latent_covariance": np.tile(0.01 * np.eye(5), (n, 1, 1)),
        "robot_latent_truth": 0.7 * curve[:, ::-1] + 0.2,
        "joints_decoded": joints,
        "joints_truth": joints,
        "window_error": np.zeros(n),
        "human_state_means": means[0],
        "human_state_covariances": covariances[0],
        "robot_state_means": means[1],
        "robot_state_covariances": covariances[1],
        "human_arm": arm,
        "human_hand": np.nan_to_num(arm[:, 2]),
        "human_skeleton": Skeleton(skeleton.joint_names, skeleton.bones, skeleton.positions[4 : 4 + n])
        if whole
        else None,
    }
    return Inference(**{**values, **fields})


def scene_rollout(robot: RobotModel, inference: Inference, **fields: Any) -> Rollout:
    """The robot moves as decoded, but bends its elbow in state 1, where it is in contact."""
    contact = inference.active_state == 1
    commanded = inference.joints_decoded + 0.3 * contact[:, None] * np.array([0.0, 0.0, 0.0, 1.0])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.diag([-1.0, -1.0, 1.0]), (0.7, -0.1, 0.1)
    target = inference.human_hand @ T[:3, :3].T + T[:3, 3]
    end_effector = robot.end_effector(commanded)
    n_states = inference.n_states
    values: dict[str, Any] = {
        "inference": inference,
        "controller": "mild-ik",
        "robot": "pepper",
        "joints_commanded": commanded,
        "end_effector": end_effector,
        "end_effector_decoded": robot.end_effector(inference.joints_decoded),
        "target": target,
        "hand_distance": np.linalg.norm(end_effector - target, axis=1),
        "contact": contact,
        "stiffness": np.where(contact[:, None], 0.4, np.ones((1, 4))),
        "compliant": True,
        "fired": np.zeros(inference.n_windows, dtype=np.int64),
        "T_world_human": T,
        "link_names": robot.link_names,
        "link_poses": robot.link_poses(commanded),
        "link_poses_decoded": robot.link_poses(inference.joints_decoded),
        "state_durations": np.ones(n_states),
        "state_occupancy": np.full(n_states, 1.0 / n_states),
        "contact_states": frozenset({1}),
        "placement": Placement(0.7, -0.1, 0.1, "invented"),
    }
    return Rollout(**{**values, **fields})


def without_truth(inference: Inference) -> Inference:
    """The partner was not recorded."""
    return replace(inference, robot_latent_truth=np.full_like(inference.robot_latent_truth, np.nan))
