"""What to command while no observation can be used: hold, then return to rest."""

from __future__ import annotations

import numpy as np

from mild_viz.streaming import Carry, Command, StreamModel

SPEED = 1.0
"""Of every joint on its way back to rest [rad/s]."""

HOLD = 2.0


def idle(model: StreamModel, carry: Carry, seconds: float) -> tuple[Carry, Command]:
    """The command of a tick without an observation, which the last `seconds` [s] have been."""
    joints = carry.control.joints
    if seconds > HOLD:
        way = model.robot.chain.rest - joints
        joints = joints + np.clip(way, -SPEED / model.rate, SPEED / model.rate)
    size = model.models[0].human_vae.latent_size
    command = Command(
        log_alpha=np.full(model.models[0].hmms[model.action].n_states, np.nan),
        log_transition=np.nan,
        active_state=-1,
        robot_latent_mean=np.full(size, np.nan),
        robot_latent_covariance=np.full((size, size), np.nan),
        joints_decoded=np.full(len(joints), np.nan),
        joints_commanded=joints,
        target=np.full(3, np.nan),
        contact=False,
        stiffness=np.ones(len(joints)),
    )
    return carry._replace(control=carry.control._replace(joints=joints)), command
