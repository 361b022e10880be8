"""A trained model as it is held in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mild_viz.errors import UserError
from mild_viz.latent.hmm import HMM
from mild_viz.latent.transition import TransitionState
from mild_viz.latent.vae import VAE
from mild_viz.settings import Placement, choose


@dataclass(frozen=True)
class RobotInterface:
    """The robot that a model was trained for: its joints in the order of the model's output."""

    name: str
    joint_names: tuple[str, ...]
    end_effector: str


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained model: one human VAE and, per action, one HMM; one robot VAE per variant."""

    path: Path
    name: str
    dataset: str
    dataset_checksum: str
    human_vae: VAE
    hmms: Mapping[str, HMM]
    robot_vaes: Mapping[str, VAE]
    robot: RobotInterface | None
    """None for a human-human model: the partner is then the second human."""
    contact_states: Mapping[str, frozenset[int]] = field(default_factory=dict)
    """States in which the partners touch, by action."""
    transition_states: Mapping[str, TransitionState] = field(default_factory=dict)
    """Where reaching turns into contact, by action; an action without one is controlled by the HMM's states alone."""
    placement: Placement | None = None
    hidden: tuple[int, int] = (40, 20)
    training: Mapping[str, Any] = field(default_factory=dict)
    """The command, seed and settings that made it."""
    metrics: Mapping[str, Any] = field(default_factory=dict)

    @property
    def variants(self) -> tuple[str, ...]:
        return tuple(self.robot_vaes)

    @property
    def actions(self) -> tuple[str, ...]:
        return tuple(self.hmms)

    @property
    def n_states(self) -> int:
        return next(iter(self.hmms.values())).n_states

    def hmm(self, action: str) -> HMM:
        choose(f"checkpoint {self.name}: action", action, self.actions)
        return self.hmms[action]

    def robot_vae(self, variant: str) -> VAE:
        choose(f"checkpoint {self.name}: variant", variant, self.variants)
        return self.robot_vaes[variant]

    def for_robot(self) -> RobotInterface:
        """The robot interface, or an error if this is a human-human model."""
        if self.robot is None:
            raise UserError(
                f"checkpoint {self.name} is a human-human model and drives no robot; train --stage hri first"
            )
        return self.robot
