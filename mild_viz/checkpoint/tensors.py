"""Named tensors of a weights file: one checked tensor, and those of transition states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mild_viz.errors import UserError
from mild_viz.latent.transition import TransitionState, check_transition_state


def checked(tensors: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A tensor in double precision, or an error that names it, its shape and the expected one."""
    if name not in tensors:
        raise UserError(f"{where}: tensor '{name}' is missing")
    if tensors[name].shape != shape:
        raise UserError(f"{where}: tensor '{name}' has shape {tensors[name].shape}, expected {shape}")
    return tensors[name].astype(np.float64)


def transition_tensors(part: str, states: Mapping[str, TransitionState], n_states: int) -> dict[str, np.ndarray]:
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


def read_transition_states(
    tensors: Mapping[str, np.ndarray], part: str, actions: Sequence[str], n_states: int, size: int, where: str
) -> dict[str, TransitionState]:
    """Those of the actions that have one: older checkpoints have none."""
    result = {}
    for action in actions:
        key = f"{part}{action}"
        if not any(name.startswith(f"{key}/") for name in tensors):
            continue
        mean, covariance, hazard, contact = (
            checked(tensors, f"{key}/{name}", shape, where)
            for name, shape in (
                ("mean", (size,)), ("covariance", (size, size)), ("hazard", (1,)), ("contact_states", (n_states,))
            )
        )  # fmt: skip
        if not np.isin(contact, (0.0, 1.0)).all():
            raise UserError(f"{where}: tensor '{key}/contact_states' is {contact}, expected 0 or 1 for every state")
        state = TransitionState(mean, covariance, float(hazard[0]), frozenset(np.flatnonzero(contact).tolist()))
        result[action] = check_transition_state(state, f"{where}: {key}")
    return result
