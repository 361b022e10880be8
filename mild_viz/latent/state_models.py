"""The kinds of hidden-state model that can be trained, and what each needs besides its own recursions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.latent import em, hsmm
from mild_viz.latent.hmm import HMM, check_hmm
from mild_viz.latent.hsmm import em as hsmm_em


class StateModel(NamedTuple):
    """A kind of hidden-state model."""

    kind: type[HMM]
    check: Callable[[Any, str], HMM]
    """Returns a model if it is valid, else raises an error that says what is wrong, and where."""
    equal_segments: Callable[[Sequence[np.ndarray], int, float], HMM]
    em_step: Callable[[Any, em.Observations, float, float], tuple[HMM, float]]


STATE_MODELS: Mapping[str, StateModel] = {
    "hmm": StateModel(HMM, check_hmm, em.equal_segments, em.em_step),
    "hsmm": StateModel(hsmm.HSMM, hsmm.check_hsmm, hsmm_em.equal_segments, hsmm_em.em_step),
}


def state_model_of(model: HMM) -> str:
    """The name of a model's kind."""
    return next(name for name, entry in STATE_MODELS.items() if type(model) is entry.kind)


def fit_from_equal_segments(
    state_model: str, sequences: Sequence[Float[np.ndarray, "_ D"]], n_states: int, floor: float, n_iterations: int
) -> HMM:
    """A model of the named kind, by EM from the equal split in time."""
    entry = STATE_MODELS[state_model]
    start = entry.equal_segments(sequences, n_states, floor)
    return em.fit(start, sequences, floor, n_iterations, step=entry.em_step)[0]
