"""Transition states from training windows: the human-only filter against that of both partners."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mild_viz.latent.hmm import HMM, forward_filter, log_emission
from mild_viz.latent.transition import TransitionState, fit_transition_state
from mild_viz.latent.vae import VAE
from mild_viz.pairs import Windows


def learn_transition_states(
    human_vae: VAE,
    partner_vae: VAE,
    hmms: Mapping[str, HMM],
    contact_states: Mapping[str, frozenset[int]],
    data: Windows,
) -> dict[str, TransitionState]:
    """By action, the transition state of `latent.transition`; none for an action without contact or without lag.

    `partner_vae` encodes the partner's windows of `data` as they were encoded when the HMMs were fitted, because the
    forward variable of both partners is the reference here: the human VAE and the second human's windows for
    HMMs of the human-human stage, the robot VAE and the robot's windows for HMMs that were trained with it. (The robot
    stage leaves those of the human-human stage as they are: its own robot latents do not follow their states.)
    """
    result = {}
    for action, hmm in hmms.items():
        states = contact_states.get(action, frozenset())
        if not states:
            continue
        human_hmm = hmm.marginal(slice(0, human_vae.latent_size))
        latents, log_alpha_human, log_alpha_joint = [], [], []
        for trial in (trial for trial, of in enumerate(data.actions) if of == action):
            rows = data.rows(trial)
            human = human_vae.encode(data.human[rows])[0]
            both = np.concatenate([human, partner_vae.encode(data.partner[rows])[0]], axis=1)
            latents.append(human)
            log_alpha_human.append(forward_filter(human_hmm, log_emission(human_hmm, human))[0])
            log_alpha_joint.append(forward_filter(hmm, log_emission(hmm, both))[0])
        state = fit_transition_state(human_hmm, states, latents, log_alpha_human, log_alpha_joint)
        if state is not None:
            result[action] = state
    return result
