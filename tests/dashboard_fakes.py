"""Small invented models, trials and rollouts for unit tests of the page (never for end-to-end tests)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mild_viz.checkpoint import Checkpoint
from mild_viz.dashboard.session import Choice
from mild_viz.dashboard.view import ViewSettings
from mild_viz.latent.vae import VAE
from mild_viz.robot.model import load_robot
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import ControlSettings, InferSettings, Placement, Settings
from mild_viz.trial import Trial

PEPPER = load_robot("pepper")
JOINTS = ("RShoulderPitch", "RShoulderRoll", "RElbowYaw", "RElbowRoll")


def make_checkpoint() -> Checkpoint:
    return Checkpoint(Path("nowhere"), "fake", "demo", "", VAE({}), {}, {}, None)


def make_trial(index: int = 0) -> Trial:
    return Trial("demo", "test", index, "handshake", 30.0, np.zeros((20, 3, 3)))


def make_choice(checkpoint: Checkpoint, trial: int = 0, variant: str = "v3.1", **control: Any) -> Choice:
    settings = Settings(InferSettings(trial=trial, variant=variant), ControlSettings(**control))
    return Choice(settings, ViewSettings(), checkpoint, make_trial(trial), PEPPER)


def with_view(choice: Choice, **view: Any) -> Choice:
    return replace(choice, view=replace(choice.view, **view))


def make_inference(n: int = 60, n_states: int = 3, trial: int = 0, **fields: Any) -> Inference:
    """`n_states` states one after the other, four joints, two latent dimensions."""
    active = np.arange(n) * n_states // n
    log_alpha = np.where(active[:, None] == np.arange(n_states), np.log(0.9), np.log(0.1 / max(n_states - 1, 1)))
    joints = np.linspace(0.0, 1.0, n)[:, None] * np.arange(1.0, 5.0)
    values: dict[str, Any] = {
        "dataset": "demo",
        "split": "test",
        "trial": trial,
        "action": "handshake",
        "variant": "v3.1",
        "rate": 30.0,
        "joint_names": JOINTS,
        "time": (np.arange(n) + 4) / 30.0,
        "observed": np.ones(n, dtype=bool),
        "tracked": np.ones(n, dtype=bool),
        "log_alpha_human": log_alpha,
        "log_alpha_joint": log_alpha,
        "log_alpha_unobserved": log_alpha,
        "active_state": active,
        "log_transition": np.full(n, -np.inf),
        "human_latent_mean": np.zeros((n, 2)),
        "human_latent_covariance": np.tile(np.eye(2), (n, 1, 1)),
        "robot_latent_mean": np.zeros((n, 2)),
        "robot_latent_covariance": np.tile(np.eye(2), (n, 1, 1)),
        "robot_latent_truth": np.zeros((n, 2)),
        "joints_decoded": joints,
        "joints_truth": joints + 0.1,
        "window_error": np.full(n, 0.02),
        "human_state_means": np.zeros((n_states, 2)),
        "human_state_covariances": np.tile(np.eye(2), (n_states, 1, 1)),
        "robot_state_means": np.zeros((n_states, 2)),
        "robot_state_covariances": np.tile(np.eye(2), (n_states, 1, 1)),
        "human_arm": np.zeros((n, 3, 3)),
        "human_hand": np.zeros((n, 3)),
    }
    return Inference(**{**values, **fields})


def make_rollout(inference: Inference, controller: str = "mild-ik", **fields: Any) -> Rollout:
    n, n_states = inference.n_windows, inference.n_states
    values: dict[str, Any] = {
        "inference": inference,
        "controller": controller,
        "robot": "pepper",
        "joints_commanded": inference.joints_decoded + 0.05,
        "end_effector": np.zeros((n, 3)),
        "end_effector_decoded": np.zeros((n, 3)),
        "target": np.zeros((n, 3)),
        "hand_distance": np.linspace(0.5, 0.0, n),
        "contact": inference.active_state == 1,
        "stiffness": np.ones((n, 4)),
        "compliant": True,
        "fired": np.zeros(n, dtype=np.int64),
        "T_world_human": np.eye(4),
        "link_names": ("torso",),
        "link_poses": np.zeros((n, 1, 7)),
        "link_poses_decoded": np.zeros((n, 1, 7)),
        "state_durations": np.full(n_states, n / n_states / 30.0),
        "state_occupancy": np.full(n_states, 1.0 / n_states),
        "contact_states": frozenset({1}),
        "placement": Placement(0.7, 0.0, 0.1, "invented"),
    }
    return Rollout(**{**values, **fields})
