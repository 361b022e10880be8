"""The same chain one observation at a time: step(model, carry, observation) -> (carry, command).

Where an observation is overdue, idle(model, carry, seconds) says what to send instead.

Fed with the frames of a trial it gives the numbers of `pipeline.infer` and `pipeline.control` row by row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.data.windows import max_gap
from mild_viz.decoding import Decoding, decoding_of
from mild_viz.errors import UserError
from mild_viz.latent.interaction import InteractionModel, ModelCarry
from mild_viz.pairs import rates_differ
from mild_viz.pipeline import set_up
from mild_viz.prediction import advance
from mild_viz.robot.contact import in_frame
from mild_viz.robot.control.controller import ControlCarry, Controller, ControlResult, Frames, make_controller
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
    controller: Controller
    others: Mapping[str, Controller]
    """Those of the robot's other arms that the model moves, by name."""
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
    """Of the robot's other arms that the model moves, by name; `joints` is what to send to each."""
    command: Command | None
    """The last command."""


class Command(NamedTuple):
    """What to send to the robot, and what led to it.

    From `idle`, what the model says is as it was at the last observation, and NaN (and state -1) before the first.
    """

    log_alpha: Float[np.ndarray, " S"]
    log_transition: float
    active_state: int
    human_latent_mean: Float[np.ndarray, " D"]
    human_latent_std: Float[np.ndarray, " D"]
    robot_latent_mean: Float[np.ndarray, " D"]
    robot_latent_covariance: Float[np.ndarray, "D D"]
    joints_decoded: Float[np.ndarray, " J"]
    joints_commanded: Float[np.ndarray, " J"]
    target: Float[np.ndarray, " 3"]
    contact: bool
    stiffness: Float[np.ndarray, " J"]
    fired: int
    """Which rules fired, as a bit mask: bit i is `robot.control.rules.RULES[i]`."""


def stream_model(
    checkpoint: Checkpoint,
    variant: str,
    action: str,
    robot: RobotModel,
    settings: ControlSettings,
    T_world_human: Float[np.ndarray, "4 4"],
    rate: float,
) -> StreamModel:
    """Everything that a stream of observations at `rate` [Hz] needs.

    Raises:
        UserError: if the checkpoint does not know the variant or the action, or was trained at another rate; or if the
            settings move another arm: a stream drives the arms that the model moves.
    """
    choose(f"checkpoint {checkpoint.name}: action", action, checkpoint.actions)
    if rates_differ(checkpoint.rate, rate):
        raise UserError(
            f"checkpoint {checkpoint.name} was trained on {checkpoint.rate:g} Hz, the stream has {rate:g} Hz; valid: "
            f"observations at {checkpoint.rate:g} Hz, or a model trained on such"
        )
    if settings.other_arm != "rest":
        raise UserError(
            f"other_arm is {settings.other_arm}; valid for a stream, which drives the arms that the model moves: rest"
        )
    controller, crosses = set_up(checkpoint, variant, action, robot, settings, rate)
    decoding = decoding_of(checkpoint, robot, rate)
    return StreamModel(
        models=checkpoint.members(variant),
        points=checkpoint.points,
        variant=variant,
        action=action,
        robot=robot,
        decoding=decoding,
        settings=controller.settings,
        controller=controller,
        others={
            arm: make_controller(robot, controller.settings, controller.rules, checkpoint.n_states, rate, arm)
            for arm in decoding.other_arms
        },
        uses_transition=crosses,
        T_world_human=T_world_human,
        rate=rate,
        max_gap=max_gap(rate),
    )


def start(model: StreamModel) -> Carry:
    """The state before the first observation: the robot rests."""
    empty = np.full((WINDOW, POINT_FEATURES * len(model.points)), np.nan)
    starts = tuple(each.start() for each in model.models)
    others = {arm: controller.start() for arm, controller in model.others.items()}
    return Carry(empty, 0, None, 0, None, starts, model.decoding.start(), model.controller.start(), others, None)


def step(
    model: StreamModel, carry: Carry, points: Float[np.ndarray, "P 3"], seconds: float | None = None
) -> tuple[Carry, Command | None]:
    """Take one observation of the human's `points` (an arm: shoulder, elbow, wrist) [m]; NaN where lost.

    `seconds` is the time since the last command [s], which the limits of the robot are about: by default that between
    two observations. Returns the new carry, and the command for the next frame: None until five observations were
    taken.
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
    frames = Frames(
        log_alpha=said.log_alpha,
        log_transition=said.log_transition if model.uses_transition else np.full(1, -np.inf),
        decoded=moved.joints,
        targets=in_frame(model.T_world_human, hand[None]),
        tracked=np.array([not np.isnan(points).any()]),
        seconds=np.array([1.0 / model.rate if seconds is None else seconds], dtype=float),
    )
    result = model.controller.run(frames, seen.control)
    others = {
        arm: controller.run(frames._replace(decoded=moved.others[arm]), seen.others[arm])
        for arm, controller in model.others.items()
    }
    command = Command(
        log_alpha=said.log_alpha[0],
        log_transition=float(said.log_transition[0]),
        active_state=int(said.log_alpha[0].argmax()),
        human_latent_mean=said.human_mean[0],
        human_latent_std=said.human_std[0],
        robot_latent_mean=said.robot_mean[0],
        robot_latent_covariance=said.robot_covariance[0],
        joints_decoded=moved.joints[0],
        target=frames.targets[0],
        **_sent(result),
    )
    seen = seen._replace(models=models, decoding=moved.carry, control=result.carry, others=_carries(others))
    return seen._replace(command=command), command


def idle(model: StreamModel, carry: Carry, seconds: float) -> tuple[Carry, Command]:
    """What to send when no usable observation came, `seconds` after the last command.

    The robot stops where it is, and returns to rest when the human is gone (`settings.Watch`), within the same limits.
    Where a frame was due and nothing came, `step` with NaN keeps the model's clock; this is for everything else. An
    observation after a pause longer than `data.windows` bridges is the first of a new window.
    """
    result = model.controller.idle(carry.control, seconds)
    others = {arm: controller.idle(carry.others[arm], seconds) for arm, controller in model.others.items()}
    if carry.command is None:
        size, n_states = model.models[0].human_vae.latent_size, model.controller.n_states
        nothing = {
            "log_alpha": np.full(n_states, np.nan), "log_transition": np.nan, "active_state": -1,
            "human_latent_mean": np.full(size, np.nan), "human_latent_std": np.full(size, np.nan),
            "robot_latent_mean": np.full(size, np.nan), "robot_latent_covariance": np.full((size, size), np.nan),
            "joints_decoded": np.full(model.robot.chain.n_joints, np.nan), "target": np.full(3, np.nan),
        }  # fmt: skip
        command = Command(**nothing, **_sent(result))
    else:
        command = carry.command._replace(**_sent(result))
    if result.carry.age * model.rate > model.max_gap:
        empty = np.full_like(carry.features, np.nan)
        carry = carry._replace(features=empty, previous=None, last_seen=None)
    return carry._replace(control=result.carry, others=_carries(others), command=command), command


def _carries(results: Mapping[str, ControlResult]) -> dict[str, ControlCarry]:
    return {arm: result.carry for arm, result in results.items()}


def _sent(result: ControlResult) -> dict[str, Any]:
    """The fields of a command that the controller makes."""
    return {
        "joints_commanded": result.joints[0],
        "contact": bool(result.contact[0]),
        "stiffness": result.stiffness[0],
        "fired": int(result.fired[0]),
    }


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
