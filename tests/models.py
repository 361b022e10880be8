"""Small random models, for tests that need some model and no particular one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint, RobotInterface
from mild_viz.latent.context import ContextLayout, fit_regression
from mild_viz.latent.hmm import HMM, safe_log
from mild_viz.latent.hsmm import HSMM
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.vae import VAE, layer_shapes
from mild_viz.robot.robots import ROBOTS
from mild_viz.settings import PAPER_VARIANTS

PEPPER = RobotInterface("pepper", ROBOTS["pepper"].joint_names, ROBOTS["pepper"].end_effector)
ACTIONS = ("wave", "handshake", "rocket", "parachute")


def random_vae(rng: np.random.Generator, input_size: int, hidden: tuple[int, int] = (40, 20), latent: int = 5) -> VAE:
    return VAE(
        {
            name: (rng.normal(size=shape) / np.sqrt(shape[-1])).astype(np.float32).astype(float)  # as it is stored
            for name, shape in layer_shapes(input_size, hidden, latent).items()
        }
    )


def random_hmm(rng: np.random.Generator, n_states: int, size: int) -> HMM:
    roots = rng.normal(size=(n_states, size, size))
    return HMM(
        rng.dirichlet(np.ones(n_states)),
        rng.dirichlet(np.ones(n_states), size=n_states),
        rng.normal(size=(n_states, size)),
        roots @ roots.transpose(0, 2, 1) + 0.3 * np.eye(size),
    )


@dataclass(frozen=True, eq=False)
class TableHSMM(HSMM):
    """A semi-Markov model with any durations: `duration_probs[i, d]` is p(a segment of i lasts d + 1 steps)."""

    duration_probs: Float[np.ndarray, "S longest"]

    @cached_property
    def log_durations(self) -> Float[np.ndarray, "S longest"]:
        return safe_log(self.duration_probs)


def without_returns(transition: np.ndarray, staying: float = 0.0) -> np.ndarray:
    """Transitions in which no state follows itself, but the last with probability `staying`."""
    off = transition * ~np.eye(len(transition), dtype=bool)
    off /= off.sum(1, keepdims=True)
    off[-1] *= 1 - staying
    off[-1, -1] = staying
    return off


def random_hsmm(rng: np.random.Generator, n_states: int, size: int, longest: float = 12.0, staying: float = 0) -> HSMM:
    hmm = random_hmm(rng, n_states, size)
    return HSMM(
        hmm.initial_probs,
        without_returns(hmm.transition_matrix, staying),
        hmm.emission_means,
        hmm.emission_covariances,
        rng.uniform(1.0, longest, n_states),
        rng.uniform(0.5, 3.0, n_states),
    )


LAYOUT = ContextLayout(lags=(3, 7), clock=2.0)


def random_own_model(rng: np.random.Generator, robot_size: int = 20) -> InteractionModel:
    """A model as those of v4: with a regression on a context."""
    size = LAYOUT.size(5)
    regressions = {
        action: fit_regression(
            rng.normal(size=(60, size)), rng.normal(size=(60, 5)), rng.dirichlet(np.ones(6), size=60), 0.1
        )
        for action in ACTIONS
    }
    hmms = {action: random_hmm(rng, 6, 10) for action in ACTIONS}
    return InteractionModel(random_vae(rng, 90), hmms, random_vae(rng, robot_size), LAYOUT, regressions)


def random_checkpoint(
    seed: int = 0,
    variants: tuple[str, ...] = PAPER_VARIANTS,
    model: Callable[[np.random.Generator, int, int], HMM] = random_hmm,
    n_own: int = 0,
) -> Checkpoint:
    """A model with the given variants, and with `n_own` models of v4."""
    rng = np.random.default_rng(seed)
    return Checkpoint(
        path=Path("nowhere"),
        name="random",
        dataset="demo",
        dataset_checksum="0" * 64,
        human_vae=random_vae(rng, 90),
        hmms={action: model(rng, 6, 10) for action in ACTIONS},
        robot_vaes={variant: random_vae(rng, 20) for variant in variants},
        robot=PEPPER,
        own_models={"v4": tuple(random_own_model(rng) for _ in range(n_own))} if n_own else {},
        rate=30.0,
        contact_states={"handshake": frozenset({2, 3})},
    )
