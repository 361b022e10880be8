"""Small random models, for tests that need some model and no particular one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint, RobotInterface
from mild_viz.latent.hmm import HMM, safe_log
from mild_viz.latent.hsmm import HSMM
from mild_viz.latent.vae import VAE, layer_shapes
from mild_viz.robot.robots import ROBOTS

PEPPER = RobotInterface("pepper", ROBOTS["pepper"].joint_names, ROBOTS["pepper"].end_effector)
ACTIONS = ("wave", "handshake", "rocket", "parachute")


def random_vae(rng: np.random.Generator, input_size: int, hidden: tuple[int, int] = (40, 20), latent: int = 5) -> VAE:
    return VAE(
        {
            name: rng.normal(size=shape) / np.sqrt(shape[-1])
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


def random_checkpoint(
    seed: int = 0,
    variants: tuple[str, ...] = ("v1", "v2.1", "v2.2", "v3.1", "v3.2"),
    model: Callable[[np.random.Generator, int, int], HMM] = random_hmm,
) -> Checkpoint:
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
        contact_states={"handshake": frozenset({2, 3})},
    )
