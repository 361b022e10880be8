"""The same chain one observation at a time: step(model, carry, observation) -> (carry, command).

Fed with the frames of a trial it gives the numbers of `pipeline.infer` and `pipeline.control` row by row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.data.windows import max_gap
from mild_viz.decoding import Decoding, decoding_of
from mild_viz.latent.interaction import InteractionModel, ModelCarry
from mild_viz.pipeline import uses_transition, with_contact_states
from mild_viz.prediction import advance
from mild_viz.robot.chain import ArmChain
from mild_viz.robot.contact import in_frame
from mild_viz.robot.controller import ControlCarry, ControlResult, initial_carry, run_controller
from mild_viz.robot.model import RobotModel
from mild_viz.settings import POINT_FEATURES, WINDOW, ControlSettings, choose
from mild_viz.trial import WRIST


@dataclass(frozen=True, eq=False)
class StreamModel:
    """What does not change between observations."""

    models: tuple[InteractionModel, ...]
    points: tuple[str, ...]
    """What is observed of the human (`Checkpoint.points`)."""
    variant: str
    action: str
    robot: RobotModel
    decoding: Decoding
    settings: ControlSettings
    uses_transition: bool
    T_world_human: Float[np.ndarray, "4 4"]
    rate: float
    """Observations a second [Hz]."""
    max_gap: int
    """Frames for which a lost observation is bridged."""


class Carry(NamedTuple):
    """What one observation leaves to the next."""

    features: Float[np.ndarray, "W F"]
    """The last window of features; NaN where not observed."""
    n_frames: int
    last_seen: Float[np.ndarray, "P 3"] | None
    """The last complete observation."""
    gap: int
    """Frames since it was seen."""
    previous: Float[np.ndarray, "P 3"] | None
    """The previous frame's filled position."""
    models: tuple[ModelCarry, ...]
    decoding: Float[np.ndarray, " J"]
    """The last decoded joints."""
    control: ControlCarry
    others: Mapping[str, ControlCarry]
    """Those of the robot's other arms that move, by name."""


class Command(NamedTuple):
    """The answer to one observation; `None` fields until the first window is full."""

    log_alpha: Float[np.ndarray, " S"]
    log_transition: float
    active_state: int
    robot_latent_mean: Float[np.ndarray, " D"]
    robot_latent_covariance: Float[np.ndarray, "D D"]
    joints_decoded: Float[np.ndarray, " J"]
    joints_commanded: Float[np.ndarray, " J"]
    target: Float[np.ndarray, " 3"]
    contact: bool
    stiffness: Float[np.ndarray, " J"]
    others_decoded: Mapping[str, Float[np.ndarray, "_"]]
    """The decoded joints of the robot's other arms that move, by name."""
    others_commanded: Mapping[str, Float[np.ndarray, "_"]]


def stream_model(
    checkpoint: Checkpoint,
    variant: str,
    action: str,
    robot: RobotModel,
    settings: ControlSettings,
    T_world_human: Float[np.ndarray, "4 4"],
    rate: float,
) -> StreamModel:
    """Everything that a stream of observations at `rate` [Hz] needs."""
    choose(f"checkpoint {checkpoint.name}: action", action, checkpoint.actions)
    settings = with_contact_states(settings, checkpoint, variant, action)
    return StreamModel(
        models=checkpoint.members(variant),
        points=checkpoint.points,
        variant=variant,
        action=action,
        robot=robot,
        decoding=decoding_of(checkpoint, robot, rate),
        settings=settings,
        uses_transition=uses_transition(settings, checkpoint.transition_state_of(variant, action)),
        T_world_human=T_world_human,
        rate=rate,
        max_gap=max_gap(rate),
    )


def start(model: StreamModel) -> Carry:
    """The state before the first observation."""
    empty = np.full((WINDOW, POINT_FEATURES * len(model.points)), np.nan)
    starts = tuple(each.start() for each in model.models)
    return Carry(empty, 0, None, 0, None, starts, model.decoding.start(), initial_carry(model.robot.chain), {})


def step(model: StreamModel, carry: Carry, points: Float[np.ndarray, "P 3"]) -> tuple[Carry, Command | None]:
    """Take one observation of the human's `points` (an arm: shoulder, elbow, wrist) [m]; NaN where lost.

    Returns the new carry, and the command for the next frame: None until five observations were taken.
    """
    seen = _observe(model, carry, points)
    if seen.n_frames < WINDOW:
        return seen, None
    window = seen.features.reshape(1, -1)
    if np.isnan(window).any():
        window = np.full_like(window, np.nan)
    said, models = advance(model.models, model.variant, model.action, window, seen.models, model.rate)
    moved = model.decoding.move(said.decoded, seen.decoding)
    hand = np.full(3, np.nan) if seen.previous is None else seen.previous[model.points.index(WRIST)]
    target = in_frame(model.T_world_human, hand[None])
    log_transition = said.log_transition if model.uses_transition else None

    def run(chain: ArmChain, decoded: np.ndarray, carry: ControlCarry) -> ControlResult:
        return run_controller(
            chain, model.settings, model.action, said.log_alpha, decoded, target, carry, log_transition
        )

    result = run(model.robot.chain, moved.joints, seen.control)
    others = {
        arm: run(model.robot.arms[arm], joints, seen.others.get(arm) or initial_carry(model.robot.arms[arm]))
        for arm, joints in moved.others.items()
    }
    command = Command(
        log_alpha=said.log_alpha[0],
        log_transition=float(said.log_transition[0]),
        active_state=int(said.log_alpha[0].argmax()),
        robot_latent_mean=said.robot_mean[0],
        robot_latent_covariance=said.robot_covariance[0],
        joints_decoded=moved.joints[0],
        joints_commanded=result.joints[0],
        target=target[0],
        contact=bool(result.contact[0]),
        stiffness=result.stiffness[0],
        others_decoded={arm: joints[0] for arm, joints in moved.others.items()},
        others_commanded={arm: one.joints[0] for arm, one in others.items()},
    )
    return seen._replace(
        models=models,
        decoding=moved.carry,
        control=result.carry,
        others={arm: one.carry for arm, one in others.items()},
    ), command


def _observe(model: StreamModel, carry: Carry, points: Float[np.ndarray, "P 3"]) -> Carry:
    """Fill a gap, take the velocity, shift the window: what data.windows does for a whole trial."""
    if np.isnan(points).any():
        gap, last_seen = carry.gap + 1, carry.last_seen
        filled = last_seen if last_seen is not None and gap <= model.max_gap else np.full_like(points, np.nan)
    else:
        gap, filled, last_seen = 0, points, points
    velocity = np.zeros_like(filled) if carry.previous is None else filled - carry.previous
    features = np.concatenate([carry.features[1:], np.concatenate([filled, velocity]).reshape(1, -1)])
    return carry._replace(features=features, n_frames=carry.n_frames + 1, last_seen=last_seen, gap=gap, previous=filled)
