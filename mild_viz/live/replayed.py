"""What a recorded session becomes: rollouts as they were, trials for other settings, and the run itself again."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import CONFIG, Checkpoint, load_checkpoint
from mild_viz.data.skeletons import ARM_JOINTS, joint_indices, to_frame
from mild_viz.decoding import open_robot
from mild_viz.errors import UserError
from mild_viz.latent.hmm import observed_rows, unobserved_forward
from mild_viz.live.config import LiveConfig
from mild_viz.live.controller import STOPPED, Decision, LiveController
from mild_viz.live.loop import Tick
from mild_viz.live.onset import INTERACTING, RETURNING
from mild_viz.live.person import skeleton_bones
from mild_viz.live.session import Session
from mild_viz.pipeline import joint_log_alpha, state_gaussians, state_visits
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import WINDOW, ControlSettings, Placement, Watch
from mild_viz.streaming import StreamModel
from mild_viz.trial import Dataset, Skeleton, Trial

DATASET = "session"
"""The name that trials of a session carry."""


def session_header(
    checkpoint: Checkpoint, model: StreamModel, robot_source: str | None, config: LiveConfig, addresses: tuple[str, str]
) -> dict[str, Any]:
    """What the first line of a session says: all that is needed to run it again."""
    return {
        "checkpoint": {
            "name": checkpoint.name,
            "path": str(checkpoint.path.resolve()),
            "checksum": checkpoint_checksum(checkpoint.path),
        },
        "variant": model.variant,
        "action": model.action,
        "robot": {"source": robot_source, "joint_names": list(model.robot.chain.joint_names)},
        "rate": model.rate,
        "control": asdict(model.settings),
        "T_world_human": model.T_world_human,
        "config": asdict(config),
        "input": addresses[0],
        "output": addresses[1],
    }


def checkpoint_checksum(path: Path) -> str:
    """SHA-256 of a model's weights and config."""
    digest = hashlib.sha256()
    for file in sorted(path.glob("*.safetensors")) + [path / CONFIG]:
        digest.update(file.read_bytes())
    return digest.hexdigest()


def session_checkpoint(session: Session, path: Path | None = None) -> Checkpoint:
    """The model that a session ran, from where it lay, or from `path`.

    Raises:
        UserError: if it is not there, or is another one by its checksum.
    """
    told = session.header["checkpoint"]
    folder = path or Path(told["path"])
    checkpoint = load_checkpoint(folder)
    if checkpoint_checksum(folder) != told["checksum"]:
        raise UserError(f"{session.path} was recorded with another model than {folder}: their checksums differ")
    return checkpoint


def session_robot(session: Session, checkpoint: Checkpoint) -> RobotModel:
    """The robot that a session drove."""
    told = session.header["robot"]
    robot = open_robot(checkpoint, told["source"])
    if list(robot.chain.joint_names) != told["joint_names"]:
        raise UserError(
            f"{session.path} drove the joints {', '.join(told['joint_names'])}; robot '{robot.name}' now has "
            f"{', '.join(robot.chain.joint_names)}"
        )
    return robot


def session_settings(session: Session) -> ControlSettings:
    """The settings of the controller in a session."""
    told = dict(session.header["control"])
    placement, states, watch = (told.pop(name) for name in ("placement", "contact_states", "watch"))
    try:
        return ControlSettings(
            **told,
            watch=Watch(**watch),
            placement=None if placement is None else Placement(**placement),
            contact_states=None if states is None else frozenset(states),
        )
    except TypeError as error:
        raise UserError(f"{session.path}: line 1: settings of another version ({error})") from None


def session_config(session: Session) -> LiveConfig:
    """The thresholds of a session."""
    try:
        return LiveConfig(**session.header["config"])
    except TypeError as error:
        raise UserError(f"{session.path}: line 1: a config of another version ({error})") from None


def interactions(session: Session) -> dict[int, tuple[Tick, ...]]:
    """By number: the turns in which the robot responded or returned."""
    found: dict[int, list[Tick]] = {}
    for tick in session.ticks:
        if tick.decision is not None and tick.sent is not None and tick.decision.phase in (INTERACTING, RETURNING):
            found.setdefault(tick.decision.interaction, []).append(tick)
    return {number: tuple(ticks) for number, ticks in found.items() if any(tick_taken(tick) for tick in ticks)}


def tick_taken(tick: Tick) -> bool:
    """Whether the model took an observation in this turn."""
    return tick.decision is not None and len(tick.decision.samples) > 0


def session_dataset(session: Session) -> Dataset:
    """The interactions of a session as recorded trials, to run with other settings.

    Raises:
        UserError: if it holds none.
    """
    trials = tuple(session_trial(session, ticks, index) for index, ticks in enumerate(interactions(session).values()))
    if not trials:
        raise UserError(f"{session.path} holds no interaction: the hand never left its resting place")
    return Dataset(DATASET, f"Live session {session.path.name}", (), trials, session.header["checkpoint"]["checksum"])


def session_trial(session: Session, ticks: tuple[Tick, ...], index: int) -> Trial:
    """One of its `interactions` as a trial, from what the model got before its start to the last frame that it took.

    Row n of its inference belongs to sample n + 4, the last row to the last sample: five frames that no row reads
    stand at the end, where a recording has the ones that are predicted.
    """
    samples = np.array([sample for tick in ticks for sample in _decision(tick).samples])
    names = tuple(session.header["robot"]["joint_names"])
    return Trial(
        dataset=DATASET,
        split="test",
        index=index,
        action=session.header["action"],
        rate=session.header["rate"],
        human_arm=np.concatenate([samples, np.repeat(samples[-1:], WINDOW, axis=0)]),
        robot_joints=np.full((len(samples) + WINDOW, len(names)), np.nan),  # nobody showed what to do instead
        robot_joint_names=names,
        partner_arm=np.full((len(samples) + WINDOW, 3, 3), np.nan),
    )


def recorded_rollout(
    session: Session, ticks: tuple[Tick, ...], index: int, checkpoint: Checkpoint, robot: RobotModel
) -> Rollout:
    """One of its `interactions` exactly as it was: row n is the n-th command that was sent."""
    header, settings = session.header, session_settings(session)
    said = [_decision(tick).command for tick in ticks]
    model = checkpoint.members(header["variant"])[0]
    hmm, size = model.hmms[header["action"]], model.human_vae.latent_size
    T_world_human = np.array(header["T_world_human"], dtype=np.float64)

    commanded = np.array([tick.sent.positions for tick in ticks if tick.sent is not None])
    human_mean = np.array([each.human_latent_mean for each in said])
    decoded = np.array([each.joints_decoded for each in said])
    arms = np.array([_arm(tick) for tick in ticks])
    target = np.array([each.target for each in said])
    active = np.array([each.active_state for each in said])
    n_rows, unknown = len(ticks), np.full(commanded.shape, np.nan)
    inference = Inference(
        dataset=f"{DATASET}, as recorded",
        split="test",
        trial=index,
        action=header["action"],
        variant=header["variant"],
        rate=header["rate"],
        joint_names=robot.chain.joint_names,
        time=np.array([tick.time for tick in ticks]) - ticks[0].time,
        observed=np.isfinite(human_mean).all(1) & np.array([tick_taken(tick) for tick in ticks]),
        tracked=observed_rows(arms.reshape(n_rows, -1)),
        log_alpha_human=np.array([each.log_alpha for each in said]),
        log_alpha_joint=joint_log_alpha(model, header["action"], human_mean, np.full_like(human_mean, np.nan)),
        log_alpha_unobserved=unobserved_forward(hmm, n_rows),
        active_state=active,
        log_transition=np.array([each.log_transition for each in said]),
        human_latent_mean=human_mean,
        human_latent_covariance=np.array([np.diag(each.human_latent_std**2) for each in said]),
        robot_latent_mean=np.array([each.robot_latent_mean for each in said]),
        robot_latent_covariance=np.array([each.robot_latent_covariance for each in said]),
        robot_latent_truth=np.full_like(human_mean, np.nan),
        joints_decoded=decoded,
        joints_truth=unknown,
        window_error=np.full(n_rows, np.nan),
        **state_gaussians(hmm, size),
        human_arm=arms,
        human_hand=to_frame(T_world_human, target),
        human_skeleton=_skeleton(ticks),
    )
    model_rules = checkpoint.contact_rules_of(header["action"])
    durations, occupancy = state_visits(active, inference.n_states, inference.rate)
    placement = settings.placement or checkpoint.placement_for(robot.chain)
    shoulder = T_world_human[:3, 3] - robot.chain.shoulder
    end_effector = robot.end_effector(commanded)
    return Rollout(
        inference=inference,
        controller=settings.controller,
        robot=robot.name,
        joints_commanded=commanded,
        end_effector=end_effector,
        end_effector_decoded=robot.end_effector(decoded),
        target=target,
        hand_distance=np.linalg.norm(end_effector - target, axis=1),
        contact=np.array([tick.sent.contact for tick in ticks if tick.sent is not None]),
        stiffness=np.array([tick.sent.stiffness for tick in ticks if tick.sent is not None]),
        compliant=model_rules.compliant,
        fired=np.array([each.fired for each in said]),
        T_world_human=T_world_human,
        link_names=robot.link_names,
        link_poses=robot.link_poses(commanded, inference.action),
        link_poses_decoded=robot.link_poses(decoded, inference.action),
        state_durations=durations,
        state_occupancy=occupancy,
        contact_states=settings.contact_states or frozenset(),
        placement=placement or Placement(*(float(value) for value in shoulder), source="assumed by the session"),
    )


def rerun(session: Session, model: StreamModel, config: LiveConfig) -> Iterator[tuple[Tick, Decision | None]]:
    """Every turn of a session, and what is decided in it with this model and these thresholds.

    With the session's own, the decisions are the recorded ones, to the bit: up to the first turn with a `fault`, since
    nobody knows how much of it was done.
    """
    controller = LiveController(model, config)
    for tick in session.ticks:
        if tick.decision is not None and tick.decision.note == STOPPED:
            controller.stop()
        if tick.seen is not None:
            yield tick, controller.observe(tick.seen, tick.time)
        else:
            yield tick, controller.tick(tick.time)


def _decision(tick: Tick) -> Decision:
    assert tick.decision is not None
    return tick.decision


def _arm(tick: Tick) -> Float[np.ndarray, "3 3"]:
    """The arm as the model took it, else as it was sent, in the person's own frame; NaN where nothing came."""
    decision = _decision(tick)
    if decision.samples:
        return decision.samples[-1]
    if tick.seen is None:
        return np.full((3, 3), np.nan)
    return _in_person(tick, tick.seen.positions[joint_indices(tick.seen.names, ARM_JOINTS)])


def _in_person(tick: Tick, points: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
    T = _decision(tick).T_world_person
    return points if T is None else to_frame(T, points)


def _skeleton(ticks: tuple[Tick, ...]) -> Skeleton | None:
    """The whole body at each command, in the person's own frame, where it was sent; NaN where nothing came."""
    names = next((tick.seen.names for tick in ticks if tick.seen is not None), ARM_JOINTS)
    if not skeleton_bones(names):
        return None
    positions = np.full((len(ticks), len(names), 3), np.nan)
    for row, tick in zip(positions, ticks, strict=True):
        if tick.seen is not None and tick.seen.names == names:
            row[:] = _in_person(tick, tick.seen.positions)
    return Skeleton(names, skeleton_bones(names), positions)
