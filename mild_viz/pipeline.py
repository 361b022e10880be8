"""The whole chain on one page: encode -> filter -> condition -> decode, then gate -> IK -> smooth -> stiffen -> limit.

`infer` depends on model, variant and trial; `control` on everything that a person may turn while watching.
Both are pure functions: a page, a command or a test calls them alike.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from mild_viz.checkpoint import Checkpoint
from mild_viz.data.windows import fill_gaps, human_windows, max_gap, windows
from mild_viz.decoding import decoding_of, hand_map_of, open_robot, points_of
from mild_viz.errors import UserError
from mild_viz.latent.hmm import HMM, forward_filter, log_emission, observed_rows, unobserved_forward
from mild_viz.latent.interaction import InteractionModel
from mild_viz.latent.transition import TransitionState
from mild_viz.pairs import check_points, check_rate, window_errors
from mild_viz.prediction import predict
from mild_viz.robot.contact import in_frame, nearest_wrists
from mild_viz.robot.control.controller import Controller, Frames, make_controller
from mild_viz.robot.control.other_arm import move_other_arms
from mild_viz.robot.control.rules import ContactRules
from mild_viz.robot.model import RobotModel
from mild_viz.robot.placement import place_human
from mild_viz.rollout import Inference, Rollout
from mild_viz.settings import CONTROLLERS_OF, WINDOW, ControlSettings, choose
from mild_viz.trial import WRIST, Trial

NEWEST = WINDOW - 1
"""Row n of a rollout belongs to the window whose newest observation is frame n + NEWEST."""


def infer(checkpoint: Checkpoint, trial: Trial, variant: str, robot: RobotModel | None = None) -> Inference:
    """What the model says about a trial: Algorithm vae-HMM-test up to the decoded joints.

    A model of a second human decodes that person's arm, which `robot` follows (default: `decoding.open_robot`).

    Raises:
        UserError: if the checkpoint does not know the variant or the action, drives another robot, or the trial is
            too short.
    """
    decoding = decoding_of(checkpoint, robot or open_robot(checkpoint), trial.rate)
    check_rate(checkpoint.rate, checkpoint.name, [trial])
    check_points(checkpoint.points, checkpoint.name, [trial])
    n_windows = trial.n_frames - 2 * WINDOW + 1
    if n_windows < 1:
        raise UserError(f"trial {trial.name} has {trial.n_frames} frames; expected at least {2 * WINDOW}")
    seen = trial.human_points
    points = fill_gaps(seen, max_gap(trial.rate))
    said = predict(checkpoint, variant, trial.action, human_windows(points)[:n_windows])

    model = checkpoint.members(variant)[0]
    hmm, size = model.hmms[trial.action], model.human_vae.latent_size
    moved, truth = decoding.move(said.decoded, decoding.start()), decoding.truth(trial)
    truth_windows = windows(truth.features)[WINDOW:]
    latent_truth, _ = model.robot_vae.encode(truth_windows)

    newest = slice(NEWEST, NEWEST + n_windows)
    first = slice(WINDOW, WINDOW + n_windows)
    return Inference(
        dataset=trial.dataset,
        split=trial.split,
        trial=trial.index,
        action=trial.action,
        variant=variant,
        rate=trial.rate,
        joint_names=decoding.joint_names,
        time=np.arange(NEWEST, NEWEST + n_windows) / trial.rate,
        observed=observed_rows(said.human_mean),
        tracked=observed_rows(seen[newest].reshape(n_windows, -1)),
        log_alpha_human=said.log_alpha,
        log_alpha_joint=joint_log_alpha(model, trial.action, said.human_mean, latent_truth),
        log_alpha_unobserved=unobserved_forward(hmm, n_windows),
        active_state=said.log_alpha.argmax(1),
        log_transition=said.log_transition,
        human_latent_mean=said.human_mean,
        human_latent_covariance=(said.human_std**2)[:, :, None] * np.eye(size),
        robot_latent_mean=said.robot_mean,
        robot_latent_covariance=said.robot_covariance,
        robot_latent_truth=latent_truth,
        joints_decoded=moved.joints,
        joints_truth=truth.joints[first],
        window_error=window_errors(said.decoded, truth_windows, moved.partner is not None),
        **state_gaussians(hmm, size),
        human_arm=trial.human_arm[newest],
        human_hand=points[newest, checkpoint.points.index(WRIST)],
        human_skeleton=None if trial.human_skeleton is None else trial.human_skeleton.rows(newest),
        partner_skeleton=None if trial.partner_skeleton is None else trial.partner_skeleton.rows(newest),
        object_track=None if trial.object_track is None else trial.object_track.rows(newest),
        transfer=transfer_row(trial, n_windows),
        phase=None if trial.phase is None else trial.phase[newest],
        decodes=checkpoint.decodes,
        partner_decoded=moved.partner,
        partner_truth=None if moved.partner is None else points_of(truth.features[first], len(checkpoint.points)),
        others_decoded=moved.others,
    )


def state_gaussians(hmm: HMM, size: int) -> dict[str, Any]:
    """Each agent's part of the states, of which the human has the first `size` dimensions: fields of `Inference`."""
    human, robot = slice(0, size), slice(size, 2 * size)
    return {
        "human_state_means": hmm.emission_means[:, human],
        "human_state_covariances": hmm.emission_covariances[:, human, human],
        "robot_state_means": hmm.emission_means[:, robot],
        "robot_state_covariances": hmm.emission_covariances[:, robot, robot],
    }


def joint_log_alpha(
    model: InteractionModel, action: str, human_mean: Float[np.ndarray, "N D"], partner_mean: Float[np.ndarray, "N D"]
) -> Float[np.ndarray, "N S"]:
    """Forward variable given both agents' latents; where the partner was lost, the human alone still says something."""
    hmm, human_hmm = model.hmms[action], model.human_hmms[action]
    both = np.concatenate([human_mean, partner_mean], axis=1)
    likelihood = np.where(observed_rows(both)[:, None], log_emission(hmm, both), log_emission(human_hmm, human_mean))
    return forward_filter(hmm, likelihood)[0]


def control(
    inference: Inference, checkpoint: Checkpoint, robot: RobotModel, trial: Trial, settings: ControlSettings
) -> Rollout:
    """The commands that a controller makes of an inference, and where everything stands: world is the robot's base.

    Raises:
        UserError: for a controller that does not go with what the model decodes, contact states that do not exist, or
            another arm that cannot be moved as the settings say.
    """
    controller, crosses = set_up(checkpoint, inference.variant, inference.action, robot, settings, inference.rate)
    settings, rules = controller.settings, controller.rules
    stored, follow = checkpoint.placement_for(robot.chain), hand_map_of(checkpoint, robot)
    placed = place_human(robot.chain, trial, settings.placement, stored, follow)
    target = in_frame(placed.T_world_human, inference.human_hand)
    frames = Frames(
        log_alpha=inference.log_alpha_human,
        log_transition=inference.log_transition if crosses else np.full(inference.n_windows, -np.inf),
        decoded=inference.joints_decoded,
        targets=target,
        tracked=inference.tracked,
        seconds=np.full(inference.n_windows, 1.0 / inference.rate),
    )
    result = controller.run(frames, controller.start())
    others = move_other_arms(
        robot, controller, frames, inference.human_skeleton, placed.T_world_human, inference.others_decoded
    )
    commanded, decoded = (
        {arm.name: getattr(arm, f"joints_{kind}") for arm in others} for kind in ("commanded", "decoded")
    )
    end_effector = robot.end_effector(result.joints)
    durations, occupancy = state_visits(inference.active_state, inference.n_states, inference.rate)
    return Rollout(
        inference=inference,
        controller=settings.controller,
        robot=robot.name,
        joints_commanded=result.joints,
        end_effector=end_effector,
        end_effector_decoded=robot.end_effector(inference.joints_decoded),
        target=target,
        hand_distance=np.linalg.norm(end_effector - target, axis=1),
        contact=result.contact,
        stiffness=result.stiffness,
        compliant=rules.compliant,
        fired=result.fired,
        T_world_human=placed.T_world_human,
        link_names=robot.link_names,
        link_poses=robot.link_poses(result.joints, inference.action, commanded),
        link_poses_decoded=robot.link_poses(inference.joints_decoded, inference.action, decoded),
        state_durations=durations,
        state_occupancy=occupancy,
        contact_states=settings.contact_states or frozenset(),
        placement=placed.placement,
        T_world_partner=partner_pose(trial, placed.T_world_human),
        object_track=None if inference.object_track is None else inference.object_track.seen_from(placed.T_world_human),
        other_arms=others,
    )


def partner_pose(trial: Trial, T_robot_human: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"] | None:
    """Where the recorded partner stands, with the human where the robot has it; None without one world frame."""
    if trial.T_world_human is None or trial.T_world_partner is None:
        return None
    return T_robot_human @ np.linalg.inv(trial.T_world_human) @ trial.T_world_partner


def set_up(
    checkpoint: Checkpoint, variant: str, action: str, robot: RobotModel, settings: ControlSettings, rate: float
) -> tuple[Controller, bool]:
    """The controller of the interacting arm at `rate` [Hz], and whether it goes by the model's transition state.

    Raises:
        UserError: for a controller that does not go with what the model decodes, or contact states that do not exist.
    """
    choose(f"model {checkpoint.name}: controller", settings.controller, CONTROLLERS_OF[checkpoint.decodes])
    settings, rules = with_contact_states(settings, checkpoint, variant, action), checkpoint.contact_rules_of(action)
    crosses = uses_transition(settings, rules, checkpoint.transition_state_of(variant, action))
    return make_controller(robot, settings, rules, checkpoint.n_states, rate), crosses


def with_contact_states(
    settings: ControlSettings, checkpoint: Checkpoint, variant: str, action: str
) -> ControlSettings:
    """The settings with contact states filled in: the chosen ones, else the checkpoint's for variant and action."""
    if settings.contact_states is None:
        return replace(settings, contact_states=checkpoint.contact_states_of(variant, action))
    bad = sorted(state for state in settings.contact_states if not 0 <= state < checkpoint.n_states)
    if bad:
        raise UserError(f"contact states {bad} do not exist; valid: 0 to {checkpoint.n_states - 1}")
    return settings


def uses_transition(settings: ControlSettings, rules: ContactRules, transition: TransitionState | None) -> bool:
    """Whether a controller uses a transition state: if the rules say so, and it leads to the chosen contact states."""
    return rules.transition_state and transition is not None and transition.contact_states == settings.contact_states


def state_visits(
    active: np.ndarray, n_states: int, rate: float
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Mean length of a visit to each state [s], and the share of time spent in it."""
    starts = np.flatnonzero(np.diff(active, prepend=-1))
    visits = np.bincount(active[starts], minlength=n_states)
    steps = np.bincount(active, minlength=n_states)
    return steps / np.maximum(visits, 1) / rate, steps / len(active)


def transfer_row(trial: Trial, n_windows: int) -> int | None:
    """The window whose newest observation is that of the transfer; None where no object or no world was recorded."""
    frame = None if trial.object_track is None else nearest_wrists(trial)
    return None if frame is None else min(max(frame - NEWEST, 0), n_windows - 1)
