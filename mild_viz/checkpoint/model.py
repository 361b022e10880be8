"""A trained model as it is held in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from mild_viz.errors import UserError
from mild_viz.latent.hmm import HMM
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.state_models import state_model_of
from mild_viz.latent.transition import TransitionState
from mild_viz.latent.vae import VAE
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.control.rules import DEFAULT_RULES, ContactRules
from mild_viz.robot.placement import Meeting
from mild_viz.robot.workspace import Workspace
from mild_viz.settings import VARIANTS, Placement, choose
from mild_viz.trial import ARM_POINTS, HAND_POINTS


@dataclass(frozen=True)
class RobotInterface:
    """The robot that a model was trained for: its joints in the order of the model's output."""

    name: str
    joint_names: tuple[str, ...]
    end_effector: str


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A trained model: one human VAE and, per action, one HMM; one robot VAE per variant.

    Variant v4 has models of its own beside them (`own_models`), whose predictions are averaged.
    """

    path: Path
    name: str
    dataset: str
    dataset_checksum: str
    human_vae: VAE
    hmms: Mapping[str, HMM]
    robot_vaes: Mapping[str, VAE]
    robot: RobotInterface | None
    """None for a human-human model: the partner is then the second human, and the human VAE serves both."""
    own_models: Mapping[str, tuple[InteractionModel, ...]] = field(default_factory=dict)
    """By variant; all of the same actions and sizes."""
    points: tuple[str, ...] = ARM_POINTS
    """What it reads of the human, and of a second human (`Trial.points`)."""
    rate: float | None = None
    """Frames a second of the recordings that it was trained on [Hz]; None where that is not known."""
    contact_states: Mapping[str, frozenset[int]] = field(default_factory=dict)
    """States in which the partners touch, by action, of the shared HMMs."""
    own_contact_states: Mapping[str, Mapping[str, frozenset[int]]] = field(default_factory=dict)
    """The same by variant and action, where a variant has HMMs of its own."""
    contact_rules: Mapping[str, ContactRules] = field(default_factory=dict)
    """How the robot behaves in contact, by action; the others follow `DEFAULT_RULES`."""
    transition_states: Mapping[str, TransitionState] = field(default_factory=dict)
    """Where reaching turns into contact, by action, in the latents that the variants share."""
    placement: Placement | None = None
    """Where the human stands before the robot that it was trained for."""
    meeting: Meeting | None = None
    """Where the hands of two humans meet, for a model that is not of one robot."""
    workspace: Workspace | None = None
    """Where the second human's hands were, for a model that decodes both of them (`HAND_POINTS`)."""
    hidden: tuple[int, int] = (40, 20)
    training: Mapping[str, Any] = field(default_factory=dict)
    """The command, seed and settings that made it."""
    metrics: Mapping[str, Any] = field(default_factory=dict)

    @property
    def variants(self) -> tuple[str, ...]:
        """The variants that it holds; a human-human model is v1 by construction (shared weights, no robot stage)."""
        shared = tuple(self.robot_vaes) if self.robot is not None else ("v1",)
        return shared + tuple(self.own_models)

    @property
    def decodes(self) -> str:
        """What it decodes of the partner: 'joints' of the robot, or of a second human the 'arm' or both 'hands'."""
        if self.robot is not None:
            return "joints"
        return "hands" if self.points == HAND_POINTS else "arm"

    @property
    def default_variant(self) -> str:
        """What is run where none is chosen: v3.1, else the first."""
        return "v3.1" if "v3.1" in self.variants else self.variants[0]

    @property
    def actions(self) -> tuple[str, ...]:
        return tuple(self.hmms)

    @property
    def n_states(self) -> int:
        return next(iter(self.hmms.values())).n_states

    @property
    def state_model(self) -> str:
        """The kind of the hidden-state models, a name in `STATE_MODELS`."""
        return state_model_of(next(iter(self.hmms.values())))

    def hmm(self, action: str) -> HMM:
        choose(f"checkpoint {self.name}: action", action, self.actions)
        return self.hmms[action]

    def members(self, variant: str) -> tuple[InteractionModel, ...]:
        """The models of a variant, whose predictions are averaged; the first one is what a page draws."""
        choose(f"checkpoint {self.name}: variant", variant, self.variants)
        if variant in self.own_models:
            return self.own_models[variant]
        return (self._shared[variant],)

    @cached_property
    def _shared(self) -> dict[str, InteractionModel]:
        vaes = self.robot_vaes if self.robot is not None else {"v1": self.human_vae}
        transitions = self.transition_states
        return {
            name: InteractionModel(self.human_vae, self.hmms, vae, transition_states=transitions)
            for name, vae in vaes.items()
        }

    def contact_states_of(self, variant: str, action: str) -> frozenset[int]:
        """States in which the partners touch, by the model's default; empty where none are known."""
        own = VARIANTS[variant].own_models
        return (self.own_contact_states.get(variant, {}) if own else self.contact_states).get(action, frozenset())

    def transition_state_of(self, variant: str, action: str) -> TransitionState | None:
        """The transition state that a controller may use; None where there is none."""
        return self.members(variant)[0].transition_states.get(action)

    def placement_for(self, chain: ArmChain) -> Placement | None:
        """Where the human stands before a robot, as far as the model knows it."""
        return self.placement or (self.meeting and self.meeting.placement(chain))

    def contact_rules_of(self, action: str) -> ContactRules:
        """How the robot behaves in the contact of an action."""
        return self.contact_rules.get(action, DEFAULT_RULES[action])

    def for_robot(self) -> RobotInterface:
        """The robot interface, or an error if this is a human-human model."""
        if self.robot is None:
            raise UserError(
                f"checkpoint {self.name} is a human-human model and was trained for no robot; train --stage hri first"
            )
        return self.robot
