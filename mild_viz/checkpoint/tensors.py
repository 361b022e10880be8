"""The tensors of a checkpoint by name, and reading them back, each checked against config.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import NamedTuple

import numpy as np

from mild_viz.checkpoint.config import Config
from mild_viz.checkpoint.model import Checkpoint
from mild_viz.errors import UserError
from mild_viz.latent.context import ContextLayout, ContextRegression
from mild_viz.latent.hmm import HMM
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.state_models import STATE_MODELS
from mild_viz.latent.transition import TransitionState, check_transition_state
from mild_viz.latent.vae import VAE, make_vae
from mild_viz.settings import POINT_FEATURES, WINDOW


def tensors_of(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """Everything by name. Networks in single precision, in which they were trained; the rest in double."""
    tensors = _vae_tensors("human/", checkpoint.human_vae) | _hmm_tensors("hmm/", checkpoint.hmms)
    tensors |= _transition_tensors("transition/", checkpoint.transition_states, checkpoint.n_states)
    for variant, vae in checkpoint.robot_vaes.items():
        tensors |= _vae_tensors(f"robot/{variant}/", vae)
    for variant, models in checkpoint.own_models.items():
        for index, model in enumerate(models):
            part = f"{variant}/{index}/"
            tensors |= _vae_tensors(f"{part}human/", model.human_vae) | _vae_tensors(f"{part}robot/", model.robot_vae)
            tensors |= _hmm_tensors(f"{part}hmm/", model.hmms)
            tensors |= _transition_tensors(f"{part}transition/", model.transition_states, checkpoint.n_states)
            for action, regression in model.regressions.items():
                for name in ContextRegression.__dataclass_fields__:
                    tensors[f"{part}regression/{action}/{name}"] = getattr(regression, name)
    return {name: np.ascontiguousarray(value) for name, value in tensors.items()}


def _vae_tensors(part: str, vae: VAE) -> dict[str, np.ndarray]:
    return {f"{part}{name}": value.astype(np.float32) for name, value in vae.weights.items()}


def _hmm_tensors(part: str, hmms: Mapping[str, HMM]) -> dict[str, np.ndarray]:
    return {
        f"{part}{action}/{field.name}": getattr(hmm, field.name)
        for action, hmm in hmms.items()
        for field in fields(hmm)
    }


def _transition_tensors(part: str, states: Mapping[str, TransitionState], n_states: int) -> dict[str, np.ndarray]:
    """The transition states of one model, by action below `part`; contact states as 1 among 0."""
    tensors = {}
    for action, state in states.items():
        tensors |= {
            f"{part}{action}/mean": state.mean,
            f"{part}{action}/covariance": state.covariance,
            f"{part}{action}/hazard": np.array([state.hazard]),
            f"{part}{action}/contact_states": np.isin(np.arange(n_states), sorted(state.contact_states)).astype(float),
        }
    return tensors


def _checked(tensors: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A tensor in double precision, or an error that names it, its shape and the expected one."""
    if name not in tensors:
        raise UserError(f"{where}: tensor '{name}' is missing")
    if tensors[name].shape != shape:
        raise UserError(f"{where}: tensor '{name}' has shape {tensors[name].shape}, expected {shape}")
    return tensors[name].astype(np.float64)


def _read_hmms(tensors: Mapping[str, np.ndarray], part: str, config: Config, where: str) -> dict[str, HMM]:
    n_states, size = config.n_states, 2 * config.latent_size
    state_model = STATE_MODELS[config.state_model]
    shapes = {
        "initial_probs": (n_states,), "transition_matrix": (n_states, n_states),
        "emission_means": (n_states, size), "emission_covariances": (n_states, size, size),
        "duration_means": (n_states,), "duration_stds": (n_states,),
    }  # fmt: skip
    names, hmms = [field.name for field in fields(state_model.kind)], {}
    for action in config.actions:
        key = f"{part}{action}"
        values = {name: _checked(tensors, f"{key}/{name}", shapes[name], where) for name in names}
        hmms[action] = state_model.check(state_model.kind(**values), f"{where}: {key}")
    return hmms


def _read_regressions(
    tensors: Mapping[str, np.ndarray], part: str, config: Config, context: int, where: str
) -> dict[str, ContextRegression]:
    states, latent = config.n_states, config.latent_size
    shapes = {"gain": (states, latent, context), "offset": (states, latent), "covariance": (states, latent, latent)}
    regressions = {}
    for action in config.actions:
        key = f"{part}{action}"
        values = {name: _checked(tensors, f"{key}/{name}", shape, where) for name, shape in shapes.items()}
        for name, value in values.items():
            if not np.isfinite(value).all():
                raise UserError(f"{where}: tensor '{key}/{name}' has values that are not finite")
        if not np.linalg.eigvalsh(values["covariance"]).min() > 0.0:
            raise UserError(f"{where}: tensor '{key}/covariance' is not positive definite")
        regressions[action] = ContextRegression(**values)
    return regressions


def _read_transition_states(
    tensors: Mapping[str, np.ndarray], part: str, config: Config, where: str
) -> dict[str, TransitionState]:
    """Those of the actions that have one: older checkpoints have none."""
    n_states, size, result = config.n_states, config.latent_size, {}
    for action in config.actions:
        key = f"{part}{action}"
        if not any(name.startswith(f"{key}/") for name in tensors):
            continue
        mean, covariance, hazard, contact = (
            _checked(tensors, f"{key}/{name}", shape, where)
            for name, shape in (
                ("mean", (size,)), ("covariance", (size, size)), ("hazard", (1,)), ("contact_states", (n_states,))
            )
        )  # fmt: skip
        if not np.isin(contact, (0.0, 1.0)).all():
            raise UserError(f"{where}: tensor '{key}/contact_states' is {contact}, expected 0 or 1 for every state")
        state = TransitionState(mean, covariance, float(hazard[0]), frozenset(np.flatnonzero(contact).tolist()))
        result[action] = check_transition_state(state, f"{where}: {key}")
    return result


def _read_vae(tensors: Mapping[str, np.ndarray], part: str, input_size: int, config: Config, where: str) -> VAE:
    own = {name.removeprefix(part): value for name, value in tensors.items() if name.startswith(part)}
    return make_vae(own, input_size, config.hidden, config.latent_size, f"{where}: {part.rstrip('/')}")


class Parts(NamedTuple):
    """What a weights file holds."""

    human_vae: VAE
    hmms: dict[str, HMM]
    robot_vaes: dict[str, VAE]
    own_models: dict[str, tuple[InteractionModel, ...]]
    transition_states: dict[str, TransitionState]


def read_parts(tensors: Mapping[str, np.ndarray], config: Config, where: str) -> Parts:
    """Every part of a model from named tensors, each checked against the config.

    Raises:
        UserError: naming the tensor, what was found and what was expected.
    """
    human_input = WINDOW * POINT_FEATURES * len(config.points)
    robot_input = WINDOW * len(config.robot.joint_names) if config.robot else human_input

    def own_model(part: str, layout: ContextLayout) -> InteractionModel:
        return InteractionModel(
            _read_vae(tensors, f"{part}human/", human_input, config, where),
            _read_hmms(tensors, f"{part}hmm/", config, where),
            _read_vae(tensors, f"{part}robot/", robot_input, config, where),
            layout,
            _read_regressions(tensors, f"{part}regression/", config, layout.size(config.latent_size), where),
            _read_transition_states(tensors, f"{part}transition/", config, where),
        )

    return Parts(
        _read_vae(tensors, "human/", human_input, config, where),
        _read_hmms(tensors, "hmm/", config, where),
        {v: _read_vae(tensors, f"robot/{v}/", robot_input, config, where) for v in config.robot_variants},
        {
            variant: tuple(own_model(f"{variant}/{index}/", own.layout) for index in range(own.n_models))
            for variant, own in config.own_models.items()
        },
        _read_transition_states(tensors, "transition/", config, where),
    )
