"""From what a person asks for to a controller that is ready: every kernel compiled, every file read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.errors import UserError
from mild_viz.live.address import parse
from mild_viz.live.config import LiveConfig
from mild_viz.live.controller import LiveController
from mild_viz.live.guard import Guard
from mild_viz.live.inputs import INPUTS
from mild_viz.live.replay import find_trial
from mild_viz.prediction import UNKNOWN_RATE
from mild_viz.robot.model import RobotModel
from mild_viz.robot.placement import T_world_human, outstretched_placement
from mild_viz.settings import ControlSettings, Placement, choose
from mild_viz.streaming import StreamModel, start, step, stream_model
from mild_viz.trial import ARM_POINTS, Trial

NOMINAL_ARM = np.array([[0.0, -0.18, 0.0], [0.03, -0.20, -0.28], [0.12, -0.20, -0.52]])
"""Shoulder, elbow and wrist of an adult whose arm hangs [m], where a model knows nobody's."""


def live_model(
    checkpoint: Checkpoint, variant: str, action: str, robot: RobotModel, settings: ControlSettings, config: LiveConfig
) -> StreamModel:
    """The model that live operation runs, at its own rate.

    Raises:
        UserError: for a variant or action that it lacks, or a model that reads other points than an arm.
    """
    if checkpoint.points != ARM_POINTS:
        raise UserError(
            f"checkpoint {checkpoint.name} reads {', '.join(checkpoint.points)} of the human; valid for live "
            f"operation: a model that reads {', '.join(ARM_POINTS)}"
        )
    rate = checkpoint.rate or UNKNOWN_RATE
    settings = replace(settings, watch=config.watch)
    placement = live_placement(checkpoint, robot, settings)
    return stream_model(checkpoint, variant, action, robot, settings, T_world_human(robot.chain, placement), rate)


def live_placement(checkpoint: Checkpoint, robot: RobotModel, settings: ControlSettings) -> Placement:
    """Where the person stands, since a tracker does not know the robot: as chosen, else as stored with the model, else
    such that the hands of an adult and of the robot meet with both arms stretched forward."""
    if (placement := settings.placement or checkpoint.placement_for(robot.chain)) is not None:
        return placement
    nominal = Trial("nominal", "test", 0, checkpoint.actions[0], 1.0, NOMINAL_ARM[None])
    return outstretched_placement(robot.chain, nominal)


def make_guard(model: StreamModel) -> Guard:
    """The last check of this model's commands: the robot's own limits, without the safety filter's margins."""
    chain, limits = model.robot.chain, model.controller.limits
    return Guard(chain.lower, chain.upper, limits.velocity, limits.rest)


def warm_up(model: StreamModel, config: LiveConfig) -> None:
    """Run everything once on a made-up reach, so that no observation waits for a compiler or a first import."""
    from mild_viz.live.messages import Observation

    rehearsal = LiveController(model, config)
    for frame, arm in enumerate(rehearsal_arms(model.rate, config)):
        seen = Observation(
            frame / model.rate, frame / model.rate, frame, "rehearsal",
            ("right_shoulder", "right_elbow", "right_wrist"), arm, "person",
        )  # fmt: skip
        rehearsal.observe(seen, frame / model.rate)
    rehearsal.tick(1e3)
    carry = start(model)
    for arm in (*(NOMINAL_ARM,) * 8, np.full((3, 3), np.nan)):
        carry, _ = step(model, carry, arm)


def rehearsal_arms(rate: float, config: LiveConfig) -> Float[np.ndarray, "N 3 3"]:
    """An arm that rests, and then reaches forward."""
    rest = round((config.calibration + 0.5) * rate) + 10
    share = np.concatenate([np.zeros(rest), np.linspace(0.0, 1.0, round(rate))])
    return NOMINAL_ARM + share[:, None, None] * np.array([[0, 0, 0], [0.15, 0, 0.1], [0.4, 0, 0.4]])


REST = 1.0
"""Seconds of rest before a trial that is replayed, where nothing else is asked for."""


def rested(source: str) -> str:
    """The address of an input; a trial that is replayed begins with some rest, as a person does who is met."""
    address = parse(source, "input", INPUTS)
    if address.scheme != "replay" or "rest" in address.options:
        return source
    return f"{source}{'&' if '?' in source else '?'}rest={REST:g}"


def choose_dataset(asked: str | None, source: str) -> str:
    """The dataset whose shipped model is used: as asked, else the one that is replayed, else demo."""
    address = parse(source, "input", INPUTS)
    return asked or (address.place.split("/")[0] if address.scheme == "replay" else "demo")


def choose_action(asked: str | None, source: str, checkpoint: Checkpoint) -> str:
    """The interaction: as asked, else that of the trial that is replayed, else a handshake, else the model's first."""
    if asked is not None:
        return choose(f"checkpoint {checkpoint.name}: action", asked, checkpoint.actions)
    address = parse(source, "input", INPUTS)
    if address.scheme == "replay":
        return find_trial(address.place).action
    return "handshake" if "handshake" in checkpoint.actions else checkpoint.actions[0]
