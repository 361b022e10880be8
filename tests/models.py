"""Small random models, for tests that need some model and no particular one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mild_viz.checkpoint import Checkpoint, RobotInterface
from mild_viz.latent.hmm import HMM
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


def random_checkpoint(seed: int = 0, variants: tuple[str, ...] = ("v1", "v2.1", "v2.2", "v3.1", "v3.2")) -> Checkpoint:
    rng = np.random.default_rng(seed)
    return Checkpoint(
        path=Path("nowhere"),
        name="random",
        dataset="demo",
        dataset_checksum="0" * 64,
        human_vae=random_vae(rng, 90),
        hmms={action: random_hmm(rng, 6, 10) for action in ACTIONS},
        robot_vaes={variant: random_vae(rng, 20) for variant in variants},
        robot=PEPPER,
        contact_states={"handshake": frozenset({2, 3})},
    )
