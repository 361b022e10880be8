"""Transition states from training windows: the human-only filter against that of both partners."""

from __future__ import annotations

from collections.abc import Mapping

from mild_viz.latent.hmm import forward_filter, log_emission
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.transition import TransitionState, fit_transition_state
from mild_viz.pairs import Windows
from mild_viz.pipeline import joint_log_alpha


def learn_transition_states(
    model: InteractionModel, contact_states: Mapping[str, frozenset[int]], data: Windows
) -> dict[str, TransitionState]:
    """By action, the transition state of `latent.transition`; none for an action without contact or without lag.

    The forward variable of both partners is the reference, so that `data` must be what the model's HMMs were fitted to:
    for those of the human-human stage both people's windows, with the human VAE as the partner's, too; for HMMs
    that were trained with a robot VAE the robot's windows. (The robot stage leaves the HMMs as they are, and its
    own robot latents do not follow their states.)
    """
    result = {}
    for action, human_hmm in model.human_hmms.items():
        states = contact_states.get(action, frozenset())
        if not states:
            continue
        latents, log_alpha_human, log_alpha_joint = [], [], []
        for trial in (trial for trial, of in enumerate(data.actions) if of == action):
            rows = data.rows(trial)
            human, partner = model.human_vae.encode(data.human[rows])[0], model.robot_vae.encode(data.partner[rows])[0]
            latents.append(human)
            log_alpha_human.append(forward_filter(human_hmm, log_emission(human_hmm, human))[0])
            log_alpha_joint.append(joint_log_alpha(model, action, human, partner))
        state = fit_transition_state(human_hmm, states, latents, log_alpha_human, log_alpha_joint)
        if state is not None:
            result[action] = state
    return result
