"""The chain: its rows, its invariants, gaps, and the stream that equals it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mild_viz import streaming
from mild_viz.checkpoint import Checkpoint
from mild_viz.data.load import load_dataset
from mild_viz.data.windows import human_windows, pair_windows
from mild_viz.errors import UserError
from mild_viz.latent.gmr import condition
from mild_viz.latent.hmm import forward_filter, log_emission
from mild_viz.pairs import robot_truth
from mild_viz.pipeline import control, infer, state_visits
from mild_viz.robot.control import rules
from mild_viz.robot.model import RobotModel
from mild_viz.rollout import SAVED, Rollout
from mild_viz.settings import CONTROLLERS_OF, PAPER_VARIANTS, VARIANTS, ControlSettings, Placement
from mild_viz.trial import Trial

pytest_plugins = ["demo_fixtures"]


def run(model: Checkpoint, robot: RobotModel, trial: Trial, variant: str = "v3.1", **settings: object) -> Rollout:
    return control(infer(model, trial, variant), model, robot, trial, ControlSettings(**settings))  # pyright: ignore[reportArgumentType]


def with_gap(trial: Trial, frames: slice) -> Trial:
    arm = trial.human_arm.copy()
    arm[frames] = np.nan
    return replace(trial, human_arm=arm)


@pytest.mark.parametrize("variant", PAPER_VARIANTS)
def test_rows_are_the_windows_of_the_trial(model: Checkpoint, handshake: Trial, variant: str) -> None:
    inference = infer(model, handshake, variant)
    joints = model.for_robot().joint_names
    human, robot_windows = pair_windows(handshake.human_arm, robot_truth(handshake, joints))
    assert inference.n_windows == handshake.n_frames - 9 == len(human)
    n = 37
    assert inference.time[n] == pytest.approx((n + 4) / handshake.rate)
    np.testing.assert_array_equal(inference.joints_truth[n], robot_truth(handshake, joints)[n + 5])
    np.testing.assert_array_equal(inference.human_arm[n], handshake.human_arm[n + 4])
    # the chain by hand, for every row
    mean, std = model.human_vae.encode(human)
    hmm = model.hmm("handshake")
    human_hmm = hmm.marginal(slice(0, 5))
    log_alpha, _ = forward_filter(human_hmm, log_emission(human_hmm, mean))
    latent, _ = condition(hmm, mean, log_alpha, std if VARIANTS[variant].posterior_covariance else None)
    decoded = model.members(variant)[0].robot_vae.decode(latent)
    np.testing.assert_allclose(inference.joints_decoded, decoded[:, :4], atol=1e-12)
    np.testing.assert_allclose(inference.window_error, ((decoded - robot_windows) ** 2).mean(1), atol=1e-12)


def test_alphas_are_probabilities_and_covariances_positive(model: Checkpoint, handshake: Trial) -> None:
    inference = infer(model, handshake, "v3.2")
    for mode in ("human", "joint", "unobserved"):
        np.testing.assert_allclose(np.exp(inference.log_alpha(mode)).sum(1), 1.0, atol=1e-12)
    np.testing.assert_array_equal(inference.active_state, inference.log_alpha_human.argmax(1))
    for covariance in (inference.human_latent_covariance, inference.robot_latent_covariance):
        assert np.linalg.eigvalsh(covariance).min() > 0


@pytest.mark.parametrize("controller", CONTROLLERS_OF["joints"])
def test_commands_stay_within_the_limits(
    model: Checkpoint, robot: RobotModel, handshake: Trial, controller: str
) -> None:
    rollout = run(model, robot, handshake, controller=controller)
    assert (rollout.joints_commanded >= robot.chain.lower).all() and (
        rollout.joints_commanded <= robot.chain.upper
    ).all()
    np.testing.assert_allclose(
        rollout.hand_distance, np.linalg.norm(rollout.end_effector - rollout.target, axis=1), atol=1e-12
    )
    wrist = handshake.human_arm[50 + 4, 2]
    expected = rollout.T_world_human[:3, :3] @ wrist + rollout.T_world_human[:3, 3]
    np.testing.assert_allclose(rollout.target[50], expected, atol=1e-12)


def test_ik_brings_the_hand_nearer_in_contact_only(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    states = model.contact_states["handshake"]
    assert states, "the demo model knows the contact states of a handshake"
    plain = run(model, robot, handshake, controller="mild", smoothing=1.0)
    adapted = run(model, robot, handshake, controller="mild-ik", smoothing=1.0)
    contact = adapted.contact
    assert 0.1 < contact.mean() < 0.9
    np.testing.assert_array_equal(contact, np.isin(adapted.inference.active_state, sorted(states)))
    by_ik, lagging = ((adapted.fired >> rules.BY_IK) & 1 == 1, np.zeros(len(contact), dtype=bool))
    np.testing.assert_array_equal(by_ik, contact)
    for bit in (rules.VELOCITY, rules.ACCELERATION):  # on the way back to the decoded joints
        lagging |= (adapted.fired >> bit) & 1 == 1
    same = ~contact & ~lagging & ~np.roll(lagging, 1)
    assert same.mean() > 0.4
    np.testing.assert_array_equal(adapted.joints_commanded[same], plain.joints_commanded[same])
    # lambda_q holds the command at the decoded joints: nearer, not exact (Eq. ik-prior-simplified)
    assert (adapted.hand_distance[contact] <= plain.hand_distance[contact] + 1e-9).all()
    tight = run(model, robot, handshake, controller="mild-ik", smoothing=1.0, lambda_q=1e-6)
    assert np.median(tight.hand_distance[contact]) < 0.02
    assert np.median(tight.hand_distance[contact]) < np.median(adapted.hand_distance[contact])


def test_no_contact_states_means_no_adaptation(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    plain = run(model, robot, handshake, controller="mild")
    none = run(model, robot, handshake, controller="mild-ik", contact_states=frozenset())
    np.testing.assert_array_equal(none.joints_commanded, plain.joints_commanded)
    assert not none.contact.any()


def test_stiffness_is_lowered_in_a_handshakes_contact_only(
    model: Checkpoint, robot: RobotModel, handshake: Trial
) -> None:
    rollout = run(model, robot, handshake)
    assert rollout.stiffness[0].min() == 1.0 and rollout.stiffness.min() < 1.0
    first, contact = int(np.argmax(rollout.stiffness.min(1) < 1.0)), int(np.argmax(rollout.contact))
    # no later than the first contact state, and before it only where the transition state outdoes all that is active
    inference, entering = rollout.inference, np.exp(rollout.inference.log_transition)
    active = np.exp(inference.log_alpha_human).max(1) * (1.0 - entering)
    assert first <= contact and (first == contact or entering[first] > active[first])
    assert run(model, robot, handshake, stiffness=False).stiffness.min() == 1.0
    rocket = next(trial for trial in load_dataset("demo").test if trial.action == "rocket")
    assert run(model, robot, rocket).stiffness.min() == 1.0


def test_a_chosen_placement_moves_the_human(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    before = run(model, robot, handshake)
    placed = before.placement
    moved = run(model, robot, handshake, placement=Placement(placed.distance + 0.1, placed.lateral, placed.height))
    np.testing.assert_allclose(moved.target - before.target, np.tile([0.1, 0, 0], (len(before.target), 1)), atol=1e-9)
    assert moved.placement.source == "chosen" and before.placement.source.startswith("recorded")


def test_hands_meet_in_contact_where_the_recording_places_them(
    model: Checkpoint, robot: RobotModel, handshake: Trial
) -> None:
    rollout = run(model, robot, handshake, lambda_q=1e-4, smoothing=1.0)
    assert np.median(rollout.hand_distance[rollout.contact]) < 0.03


@pytest.mark.parametrize("length", [3, 40])
def test_gaps_are_filtered_over(model: Checkpoint, robot: RobotModel, handshake: Trial, length: int) -> None:
    trial = with_gap(handshake, slice(60, 60 + length))
    rollout = run(model, robot, trial)
    inference = rollout.inference
    assert np.isnan(inference.human_arm[60 - 4]).all()  # shown as a gap
    assert inference.observed[60 - 4 : 63 - 4].all()  # bridged by the last observation
    assert inference.observed.all() == (length == 3)  # for half a second, no longer
    np.testing.assert_array_equal(np.flatnonzero(~inference.tracked), np.arange(60 - 4, 60 - 4 + length))
    for array in (inference.log_alpha_human, inference.log_alpha_joint):
        np.testing.assert_allclose(np.exp(array).sum(1), 1.0, atol=1e-12)
    assert np.isfinite(rollout.joints_commanded).all() and np.isfinite(rollout.link_poses).all()


def test_a_trial_that_begins_unseen_still_runs(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    rollout = run(model, robot, with_gap(handshake, slice(0, 30)))
    assert not rollout.inference.observed[:20].any() and rollout.inference.observed[-1]
    assert np.isfinite(rollout.joints_commanded).all()


def test_wrong_choices_list_the_valid_ones(model: Checkpoint, robot: RobotModel, handshake: Trial) -> None:
    with pytest.raises(UserError, match="variant 'v9' is unknown; valid: v1, v2.1"):
        infer(model, handshake, "v9")
    with pytest.raises(UserError, match=r"\[9\] do not exist; valid: 0 to 5"):
        run(model, robot, handshake, contact_states=frozenset({9}))
    with pytest.raises(UserError, match="controller 'pid' is unknown; valid: base-ik, mild, mild-ik"):
        ControlSettings(controller="pid")
    with pytest.raises(UserError, match="lambda_q is -1"):
        ControlSettings(lambda_q=-1.0)
    short = replace(
        handshake, human_arm=handshake.human_arm[:9], partner_arm=None, phase=None, human_skeleton=None,
        partner_skeleton=None, robot_joints=np.zeros((9, 4)), robot_joint_names=model.for_robot().joint_names,
    )  # fmt: skip
    with pytest.raises(UserError, match="9 frames; expected at least 10"):
        infer(model, short, "v3.1")


def test_a_rollout_file_holds_every_named_array(
    model: Checkpoint, robot: RobotModel, handshake: Trial, tmp_path: Path
) -> None:
    rollout = run(model, robot, handshake)
    rollout.save(tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as arrays:
        assert set(arrays.files) == set(SAVED)
        assert {len(arrays[name]) for name in SAVED} == {rollout.inference.n_windows}
        np.testing.assert_array_equal(arrays["joints_commanded"], rollout.joints_commanded)
    assert [p.name for p in tmp_path.iterdir()] == ["out.npz"]


def test_state_visits_count_stays() -> None:
    durations, occupancy = state_visits(np.array([0, 0, 1, 1, 1, 0, 2, 2]), 4, rate=2.0)
    np.testing.assert_allclose(durations, [0.75, 1.5, 1.0, 0.0])
    np.testing.assert_allclose(occupancy, [3 / 8, 3 / 8, 2 / 8, 0.0])


@pytest.mark.parametrize("variant", ["v3.1", "v3.2"])
@pytest.mark.parametrize("controller", CONTROLLERS_OF["joints"])
def test_streaming_equals_batch(
    model: Checkpoint, robot: RobotModel, handshake: Trial, variant: str, controller: str
) -> None:
    trial = with_gap(with_gap(handshake, slice(70, 73)), slice(100, 130))
    rollout = run(model, robot, trial, variant, controller=controller)
    inference = rollout.inference
    stream = streaming.stream_model(
        model, variant, trial.action, robot, ControlSettings(controller=controller), rollout.T_world_human, trial.rate
    )
    carry = streaming.start(stream)
    for frame, arm in enumerate(trial.human_arm[: inference.n_windows + 4]):
        carry, command = streaming.step(stream, carry, arm)
        n = frame - 4
        if n < 0:
            assert command is None
            continue
        assert command is not None
        expected = {
            "log_alpha": inference.log_alpha_human, "robot_latent_mean": inference.robot_latent_mean,
            "robot_latent_covariance": inference.robot_latent_covariance, "joints_decoded": inference.joints_decoded,
            "joints_commanded": rollout.joints_commanded, "target": rollout.target, "stiffness": rollout.stiffness,
        }  # fmt: skip
        for name, array in expected.items():
            np.testing.assert_allclose(getattr(command, name), array[n], atol=1e-9, rtol=0, err_msg=f"{name} at {n}")
        assert command.fired == rollout.fired[n]
        assert command.contact == rollout.contact[n] and command.active_state == inference.active_state[n]


def test_an_observation_reaches_only_later_rows(model: Checkpoint, handshake: Trial) -> None:
    before = infer(model, handshake, "v3.1")
    arm = handshake.human_arm.copy()
    arm[80:] += 0.05
    after = infer(model, replace(handshake, human_arm=arm), "v3.1")
    np.testing.assert_array_equal(before.joints_decoded[: 80 - 4], after.joints_decoded[: 80 - 4])
    assert np.abs(before.joints_decoded[80 - 4 :] - after.joints_decoded[80 - 4 :]).max() > 1e-3
    assert human_windows(arm).shape[1] == 90
